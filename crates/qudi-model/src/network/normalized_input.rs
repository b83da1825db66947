//! The pre-denoiser's inputs in numbers that mean the same in any light: sigmas of the merged frame's noise.

use super::layers::CORRECTION;
use crate::conditioning::{AlignedTensors, Conditioning};
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
pub(super) struct NormalizedInput {
    /// What the pre-denoiser corrects, in image units: the reference estimate, or without one the linear
    /// estimate.
    pub(super) start: Tensor<4>,
    /// Sigma of the noise in image units: of the merged image, or of the linear estimate at the mean light.
    /// Errors of pre-denoised frames are some tenths of it.
    pub(super) sigma: Tensor<4>,
    /// The merged image's difference from the reference estimate, or counts in [-1, 1].
    pub(super) difference: Tensor<4>,
    /// What the pre-denoiser sees: `[images, planes, H, W]`.
    pub(super) planes: Tensor<4>,
    /// The factor of the pre-denoiser's correction, in sigmas.
    pub(super) correction: f32,
}

impl NormalizedInput {
    /// Normalizes what a network is given.
    pub(super) fn new(conditioning: &Conditioning) -> Self {
        match &conditioning.aligned {
            Some(aligned) => Self::aligned(aligned),
            None => Self::single_image(conditioning),
        }
    }

    /// Normalizes aligned frames.
    ///
    /// The planes are difference, the reference estimate's contrast to its surroundings, the estimate
    /// itself, the logarithm of sigma, the counts of the frame and of its `K` neighbours, and what is
    /// expected of the neighbours.
    pub(super) fn aligned(aligned: &AlignedTensors) -> Self {
        let AlignedTensors { reference, merged, noise_sigma, counts, expected } = aligned.clone();
        let sigma = noise_sigma.clamp_min(MIN_SIGMA);
        let difference = (merged - reference.clone()) / sigma.clone();
        let difference = difference.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE) * 0.5;
        let around = mean_around(mean_around(reference.clone(), CONTRAST_RADIUS), CONTRAST_RADIUS);
        let contrast = asinh((reference.clone() - around) / sigma.clone());
        let log_sigma = sigma.clone().log() + 3.0;
        let counts = counts.clamp(-MAX_COUNT, MAX_COUNT) * 0.5;
        let signed = reference.clone() * 2.0 - 1.0;
        let mut planes = vec![difference.clone(), contrast, signed, log_sigma, counts];
        planes.extend(expected.map(|expected| asinh(expected * 2.0)));
        Self {
            start: reference,
            sigma,
            difference,
            planes: Tensor::cat(planes, 1),
            correction: CORRECTION,
        }
    }

    /// Normalizes single frames: linear estimate, counts over full scale, and the logarithm of sigma.
    fn single_image(conditioning: &Conditioning) -> Self {
        let start = conditioning.linear_estimate.clone();
        let sigma = conditioning.noise_variance().sqrt().clamp_min(MIN_SIGMA);
        let sigma = sigma.expand(start.dims());
        let counts = conditioning.counts.clone() * 2.0 - 1.0;
        let log_sigma = sigma.clone().log() + 3.0;
        let planes = vec![start.clone() * 2.0 - 1.0, counts.clone(), log_sigma];
        Self { planes: Tensor::cat(planes, 1), start, sigma, difference: counts, correction: 1.0 }
    }

    /// The same with `f` of every tensor.
    pub(super) fn map(&self, f: &dyn Fn(Tensor<4>) -> Tensor<4>) -> Self {
        Self {
            start: f(self.start.clone()),
            sigma: f(self.sigma.clone()),
            difference: f(self.difference.clone()),
            planes: f(self.planes.clone()),
            correction: self.correction,
        }
    }

    /// What the pre-denoiser corrects, in [-1, 1].
    pub(super) fn signed(&self) -> Tensor<4> {
        self.start.clone() * 2.0 - 1.0
    }
}

/// Inverse hyperbolic sine. Of the magnitude alone, for large negative numbers would take the logarithm of a
/// difference.
fn asinh(x: Tensor<4>) -> Tensor<4> {
    let size = x.clone().abs();
    let root = (size.clone() * size.clone() + 1.0).sqrt();
    (size + root).log() * x.sign()
}
