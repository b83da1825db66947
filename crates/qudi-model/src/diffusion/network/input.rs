//! Single frames as the pre-denoiser sees them.

use crate::diffusion::Conditioning;
use burn::tensor::Tensor;

/// The least sigma in image units: what is known better needs no correction.
const MIN_SIGMA: f32 = 1e-3;

/// The normalized inputs of frames, `[images, 1, H, W]` each but the planes.
#[derive(Clone, Debug)]
pub(crate) struct NormalizedInput {
    /// Linear estimate, which the pre-denoiser corrects, in image units.
    pub(crate) linear_estimate: Tensor<4>,
    /// Sigma of the linear estimate's noise at the mean light.
    pub(crate) sigma: Tensor<4>,
    /// Counts in [-1, 1].
    pub(crate) counts: Tensor<4>,
    /// Inputs of the pre-denoiser: `[images, 3, H, W]`.
    pub(crate) planes: Tensor<4>,
}

impl NormalizedInput {
    /// Normalizes single frames: linear estimate, counts over full scale, and the logarithm of sigma.
    pub(crate) fn new(conditioning: &Conditioning) -> Self {
        let linear_estimate = conditioning.linear_estimate.clone();
        let sigma = conditioning.noise_variance().sqrt().clamp_min(MIN_SIGMA);
        let sigma = sigma.expand(linear_estimate.dims());
        let counts = conditioning.counts.clone() * 2.0 - 1.0;
        let log_sigma = sigma.clone().log() + 3.0;
        let planes = vec![linear_estimate.clone() * 2.0 - 1.0, counts.clone(), log_sigma];
        Self { planes: Tensor::cat(planes, 1), linear_estimate, sigma, counts }
    }
}
