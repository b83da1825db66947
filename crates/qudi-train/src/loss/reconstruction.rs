//! The loss of images: squared error and total variation of the error.

use burn::tensor::Tensor;

/// The weight of the total variation of the error.
const TOTAL_VARIATION: f32 = 0.01;

/// The least mean squared error that counts as a unit: better reference estimates leave nothing to learn.
const LEAST_ERROR: f32 = 1e-4;

/// Computes `mean e^2 + 0.01 (mean |dx e| + mean |dy e|)` of the error `e = p - q`, where `dx` and `dy` are
/// the differences of neighbours along rows and columns.
///
/// # Shapes
/// - p, q: `[images, 1, height, width]` in [0, 1]
/// - output: `[1]`
pub fn reconstruction(p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
    let error = p - q;
    let [_, _, height, width] = error.dims();
    let difference = |axis: usize, size: usize| {
        let part = |first| error.clone().narrow(axis, first, size - 1);
        (part(1) - part(0)).abs().mean()
    };
    let variation = difference(3, width) + difference(2, height);
    error.powi_scalar(2).mean() + variation * TOTAL_VARIATION
}

/// Computes [`reconstruction`] with errors in a unit of their own for every burst. Otherwise a few dark
/// bursts, whose errors are thirty times as large as errors of bright ones, would decide.
///
/// # Shapes
/// - estimate, truth: `[bursts * frames, 1, height, width]` in [0, 1]
/// - unit: `[bursts * frames, 1, 1, 1]`
/// - output: `[1]`
pub(crate) fn relative_reconstruction(
    estimate: Tensor<4>,
    truth: Tensor<4>,
    unit: Tensor<4>,
) -> Tensor<1> {
    let scale = unit.clamp_min(LEAST_ERROR.sqrt()).recip().detach();
    reconstruction(estimate * scale.clone(), truth * scale)
}

/// Computes the root of the mean squared error over each burst, without gradient.
///
/// # Shapes
/// - error: `[bursts * frames, 1, height, width]`
/// - output: `[bursts * frames, 1, 1, 1]`
pub(crate) fn root_mean_square(error: Tensor<4>, frames: usize) -> Tensor<4> {
    let [images, _, height, width] = error.dims();
    let bursts = images / frames;
    let squares = error.detach().powi_scalar(2).reshape([bursts, frames * height * width]);
    let root = squares.mean_dim(1).sqrt();
    root.repeat_dim(1, frames).reshape([images, 1, 1, 1])
}
