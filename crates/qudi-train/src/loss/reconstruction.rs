//! The loss of images: squared error and total variation of the error.

use burn::tensor::Tensor;

/// The weight of the total variation of the error.
const TOTAL_VARIATION: f32 = 0.01;

/// The least mean squared error that a reference estimate counts with: better ones leave nothing to learn.
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

/// Computes [`reconstruction`] with errors in units of the root of the reference estimate's mean squared
/// error over each burst. Otherwise a few dark bursts, whose errors are thirty times those of bright ones,
/// would decide.
///
/// # Shapes
/// - estimate, truth, reference: `[bursts * frames, 1, height, width]` in [0, 1]
/// - output: `[1]`
pub(crate) fn relative_reconstruction(
    estimate: Tensor<4>,
    truth: Tensor<4>,
    reference: Tensor<4>,
    frames: usize,
) -> Tensor<1> {
    let error = (reference - truth.clone()).detach();
    let [images, _, height, width] = error.dims();
    let bursts = images / frames;
    let error = error.powi_scalar(2).reshape([bursts, frames * height * width]).mean_dim(1);
    let scale = error.clamp_min(LEAST_ERROR).sqrt().recip();
    let scale = scale.repeat_dim(1, frames).reshape([images, 1, 1, 1]);
    reconstruction(estimate * scale.clone(), truth * scale)
}
