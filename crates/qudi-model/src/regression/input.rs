//! The pre-denoisers' inputs in numbers that mean the same in any light: sigmas of the merged frame's noise.

use crate::aligned::Aligned;
use burn::tensor::Tensor;
use qudi_layers::resample::mean_around;

/// The least sigma in image units: what is known better needs no correction.
const MIN_SIGMA: f32 = 1e-3;

/// Differences of more sigmas than this are no noise.
const MAX_DIFFERENCE: f32 = 5.0;

/// Counts differ by no more sigmas from what is expected, but for rare events.
const MAX_COUNT: f32 = 8.0;

/// Radius of the means that contrast is measured from; they are taken twice.
const CONTRAST_RADIUS: usize = 4;

/// The normalized inputs of frames, `[images, 1, H, W]` each but the planes.
#[derive(Clone, Debug)]
pub(crate) struct NormalizedInput {
    /// Reference estimate, which the pre-denoiser corrects, in image units.
    pub(crate) reference: Tensor<4>,
    /// Sigma of the merged frame's noise in image units. Errors of pre-denoised frames are some tenths of it.
    pub(crate) sigma: Tensor<4>,
    /// Inputs of the pre-denoiser: `[images, planes, H, W]`.
    pub(crate) planes: Tensor<4>,
}

impl NormalizedInput {
    /// Normalizes aligned frames.
    ///
    /// The planes are difference, the reference estimate's contrast to its surroundings, the estimate
    /// itself, the logarithm of sigma, the counts of the frame and of its `K` neighbours, and what is
    /// expected of the neighbours.
    pub(crate) fn new(aligned: &Aligned<Tensor<4>>) -> Self {
        let Aligned { reference, merged, noise_sigma, counts, expected } = aligned.clone();
        let sigma = noise_sigma.clamp_min(MIN_SIGMA);
        let difference = (merged - reference.clone()) / sigma.clone();
        let difference = difference.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE) * 0.5;
        let around = mean_around(mean_around(reference.clone(), CONTRAST_RADIUS), CONTRAST_RADIUS);
        let contrast = asinh((reference.clone() - around) / sigma.clone());
        let log_sigma = sigma.clone().log() + 3.0;
        let counts = Tensor::cat(counts, 1).clamp(-MAX_COUNT, MAX_COUNT) * 0.5;
        let signed = reference.clone() * 2.0 - 1.0;
        let expected = asinh(Tensor::cat(expected, 1) * 2.0);
        let planes = vec![difference, contrast, signed, log_sigma, counts, expected];
        Self { reference, sigma, planes: Tensor::cat(planes, 1) }
    }
}

/// Inverse hyperbolic sine. Of the magnitude alone, for large negative numbers would take the logarithm of a
/// difference.
fn asinh(x: Tensor<4>) -> Tensor<4> {
    let size = x.clone().abs();
    let root = (size.clone() * size.clone() + 1.0).sqrt();
    (size + root).log() * x.sign()
}
