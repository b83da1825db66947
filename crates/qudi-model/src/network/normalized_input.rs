//! The pre-denoiser's inputs in numbers that mean the same in any light: sigmas of the merged frame's noise.

use super::layers::resample::mean_around;
use crate::conditioning::AlignedTensors;
use burn::tensor::Tensor;

/// The least sigma in image units: what is known better needs no correction.
const MIN_SIGMA: f32 = 1e-3;

/// Differences of more sigmas than this are no noise.
const MAX_DIFFERENCE: f32 = 5.0;

/// Counts differ by no more sigmas from what is expected, but for rare events.
const MAX_COUNT: f32 = 8.0;

/// Radius of the means that contrast is measured from; they are taken twice.
const CONTRAST_RADIUS: usize = 4;

/// The normalized inputs of frames, `[images, 1, H, W]` each but the last.
#[derive(Clone, Debug)]
pub(super) struct NormalizedInput {
    /// The reference estimate, in image units.
    pub(super) reference: Tensor<4>,
    /// Sigma of the merged image's noise, in image units; errors of the reference estimate are some tenths of
    /// it.
    pub(super) sigma: Tensor<4>,
    /// The merged image's difference from the reference estimate.
    pub(super) difference: Tensor<4>,
    /// The reference estimate's contrast to its surroundings, compressed.
    pub(super) contrast: Tensor<4>,
    /// The logarithm of sigma.
    pub(super) log_sigma: Tensor<4>,
    /// Counts of the frame and of its `K` neighbours, then what is expected of the neighbours:
    /// `[images, 2 K + 1, H, W]`.
    pub(super) aligned: Tensor<4>,
}

impl NormalizedInput {
    /// Normalizes aligned frames.
    pub(super) fn new(aligned: &AlignedTensors) -> Self {
        let AlignedTensors { reference, merged, noise_sigma, counts, expected } = aligned.clone();
        let sigma = noise_sigma.clamp_min(MIN_SIGMA);
        let difference = (merged - reference.clone()) / sigma.clone();
        let mut planes = vec![counts.clamp(-MAX_COUNT, MAX_COUNT) * 0.5];
        planes.extend(expected.map(|expected| asinh(expected * 2.0)));
        let around = mean_around(mean_around(reference.clone(), CONTRAST_RADIUS), CONTRAST_RADIUS);
        let contrast = (reference.clone() - around) / sigma.clone();
        Self {
            difference: difference.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE) * 0.5,
            contrast: asinh(contrast),
            log_sigma: sigma.clone().log() + 3.0,
            aligned: Tensor::cat(planes, 1),
            reference,
            sigma,
        }
    }

    /// The reference estimate in [-1, 1].
    pub(super) fn signed(&self) -> Tensor<4> {
        self.reference.clone() * 2.0 - 1.0
    }
}

/// Inverse hyperbolic sine. Of the magnitude alone, for large negative numbers would take the logarithm of a
/// difference.
fn asinh(x: Tensor<4>) -> Tensor<4> {
    let size = x.clone().abs();
    let root = (size.clone() * size.clone() + 1.0).sqrt();
    (size + root).log() * x.sign()
}
