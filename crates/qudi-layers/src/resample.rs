//! Resampling: pixels into channels, finer and coarser grids, and flows between scales.

use burn::tensor::Tensor;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::{AvgPoolOptions, PadMode};
use qudi_kernels::{Resampling, resampled};

/// Reshapes `[bursts * frames, c, h, w]` to `[bursts, frames, c, h, w]`.
pub fn by_burst(x: Tensor<4>, frames: usize) -> Tensor<5> {
    let [images, c, h, w] = x.dims();
    x.reshape([images / frames, frames, c, h, w])
}

/// Moves squares of `fold` x `fold` pixels into channels.
///
/// # Shapes
/// - x: `[images, channels, height * fold, width * fold]`
/// - result: `[images, channels * fold * fold, height, width]`
pub fn pixel_unshuffle(x: Tensor<4>, fold: usize) -> Tensor<4> {
    if fold == 1 {
        return x;
    }
    if let Some(result) = resampled(&x, Resampling::Unshuffle(fold)) {
        return result;
    }
    let [images, channels, height, width] = x.dims();
    let [h, w] = [height / fold, width / fold];
    x.reshape([images, channels, h, fold, w, fold]).permute([0, 1, 3, 5, 2, 4]).reshape([
        images,
        channels * fold * fold,
        h,
        w,
    ])
}

/// Applies the inverse of [`pixel_unshuffle`].
pub fn pixel_shuffle(x: Tensor<4>, fold: usize) -> Tensor<4> {
    if fold == 1 {
        return x;
    }
    if let Some(result) = resampled(&x, Resampling::Shuffle(fold)) {
        return result;
    }
    let [images, channels, h, w] = x.dims();
    let planes = channels / (fold * fold);
    x.reshape([images, planes, fold, fold, h, w]).permute([0, 1, 4, 2, 5, 3]).reshape([
        images,
        planes,
        h * fold,
        w * fold,
    ])
}

/// Averages squares of 2 x 2 pixels.
///
/// # Shapes
/// - x: `[images, channels, height, width]`
/// - result: `[images, channels, height / 2, width / 2]`
pub fn avg_pool2(x: Tensor<4>) -> Tensor<4> {
    resampled(&x, Resampling::Pool).unwrap_or_else(|| avg_pool2d(x, AvgPoolOptions::new([2, 2])))
}

/// Averages squares of `scale` x `scale` pixels; `scale` must be a power of two.
pub fn shrink(mut x: Tensor<4>, scale: usize) -> Tensor<4> {
    for _ in 0..scale.ilog2() {
        x = avg_pool2(x);
    }
    x
}

/// Doubles the size with bilinear interpolation, half-pixel centres and repeated edges. On graphics cards it
/// is composed of simple operations, because Burn's interpolation has no gradient there.
pub fn upsample2(x: Tensor<4>) -> Tensor<4> {
    resampled(&x, Resampling::Upsample).unwrap_or_else(|| upsample2_axis(upsample2_axis(x, 2), 3))
}

fn upsample2_axis(x: Tensor<4>, axis: usize) -> Tensor<4> {
    let size = x.dims()[axis];
    let mut pads = [(0, 0); 4];
    pads[axis] = (1, 1);
    let padded = x.clone().pad(pads, PadMode::Edge);
    let near = x * 0.75;
    let before = near.clone() + padded.clone().narrow(axis, 0, size) * 0.25;
    let after = near + padded.narrow(axis, 2, size) * 0.25;
    let mut shape = before.dims();
    shape[axis] *= 2;
    Tensor::stack::<5>(vec![before, after], axis + 1).reshape(shape)
}

/// Repeats each pixel twice in both directions.
pub fn repeat(x: Tensor<4>) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    x.reshape([images, channels, height, 1, width, 1]).repeat(&[1, 1, 1, 2, 1, 2]).reshape([
        images,
        channels,
        height * 2,
        width * 2,
    ])
}

/// Converts a flow from one scale to another; both must be powers of two.
pub fn rescale_flow(mut flow: Tensor<4>, from: usize, to: usize) -> Tensor<4> {
    let mut scale = from;
    while scale > to {
        flow = upsample2(flow) * 2.0;
        scale /= 2;
    }
    while scale < to {
        flow = avg_pool2(flow) * 0.5;
        scale *= 2;
    }
    flow
}

/// Averages squares of `2 * radius + 1` pixels around each pixel, with repeated edges; `radius` must be 2 or
/// 4.
pub fn mean_around(x: Tensor<4>, radius: usize) -> Tensor<4> {
    mean_axis(mean_axis(x, 2, radius), 3, radius)
}

fn mean_axis(x: Tensor<4>, axis: usize, radius: usize) -> Tensor<4> {
    let size = x.dims()[axis];
    let mut pads = [(0, 0); 4];
    pads[axis] = (radius, radius);
    let padded = x.pad(pads, PadMode::Edge);
    // Sums of `count` values, `step` apart, beginning at each of the first `size` positions.
    let sums = |x: &Tensor<4>, size: usize, step: usize, count: usize| {
        let at = |k: usize| x.clone().narrow(axis, k * step, size);
        (1..count).fold(at(0), |sum, k| sum + at(k))
    };
    let sum = if radius == 4 {
        sums(&sums(&padded, size + 6, 1, 3), size, 3, 3) // nine as three threes
    } else {
        sums(&padded, size, 1, 2 * radius + 1)
    };
    sum / (2 * radius + 1) as f32
}

/// Computes central differences along rows and along columns, with repeated edges.
pub fn differences(x: Tensor<4>) -> (Tensor<4>, Tensor<4>) {
    let along = |axis: usize| {
        let size = x.dims()[axis];
        let mut pads = [(0, 0); 4];
        pads[axis] = (1, 1);
        let padded = x.clone().pad(pads, PadMode::Edge);
        (padded.clone().narrow(axis, 2, size) - padded.narrow(axis, 0, size)) * 0.5
    };
    (along(3), along(2))
}
