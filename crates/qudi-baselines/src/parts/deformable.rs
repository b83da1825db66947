//! Modulated deformable convolution (Zhu et al., "Deformable ConvNets v2", CVPR 2019).

use super::{same_flow, warp_zeros};
use burn::tensor::Tensor;

/// Taps of a kernel of 3 x 3.
const TAPS: usize = 9;

/// Applies a 3 x 3 convolution whose taps have offsets and are weighted by a mask; zeros outside.
///
/// # Shapes
/// - x: `[images, channels, height, width]`
/// - offset: `[images, groups * 18, height, width]`: y before x for every tap of every group of channels, in
///   pixels
/// - mask: `[images, groups * 9, height, width]`
/// - weight: `[outputs, channels, 3, 3]`
/// - bias: `[outputs]`
/// - result: `[images, outputs, height, width]`
pub fn deform_conv(
    x: Tensor<4>,
    offset: Tensor<4>,
    mask: Tensor<4>,
    weight: Tensor<4>,
    bias: Tensor<1>,
) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let groups = mask.dims()[1] / TAPS;
    let pixels = height * width;
    let samples: Tensor<5> = deform_samples(x, offset, groups).reshape([
        images,
        groups,
        channels / groups,
        TAPS,
        pixels,
    ]);
    let columns = samples * mask.reshape([images, groups, 1, TAPS, pixels]);
    let columns: Tensor<3> = columns.reshape([images, channels * TAPS, pixels]);
    let outputs = bias.dims()[0];
    let weight: Tensor<3> = weight.reshape([1, outputs, channels * TAPS]);
    weight.matmul(columns).reshape([images, outputs, height, width])
        + bias.reshape([1, outputs, 1, 1])
}

/// Returns what the taps of such a convolution see.
///
/// # Shapes
/// - x, offset: as of [`deform_conv`]
/// - result: `[images, channels, 9, height * width]`
pub fn deform_samples(x: Tensor<4>, offset: Tensor<4>, groups: usize) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let (all, own) = (images * groups, channels / groups);
    let x = x.reshape([all, own, height, width]);
    let offset: Tensor<5> = offset.reshape([all, TAPS, 2, height, width]);
    let taps = (0..TAPS).map(|tap| {
        let from = offset.clone().narrow(1, tap, 1).reshape([all, 2, height, width]);
        let place = [(tap % 3) as f32 - 1.0, (tap / 3) as f32 - 1.0];
        warp_zeros(x.clone(), from.flip([1]) + same_flow(place, &x.device()))
    });
    let samples: Tensor<5> = Tensor::stack(taps.collect(), 2);
    samples.reshape([images, channels, TAPS, height * width])
}
