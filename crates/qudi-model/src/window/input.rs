//! The inputs in numbers of about unit size.

use super::config::{FOLD, LEVELS};
use crate::diffusion::Conditioning;
use burn::tensor::Tensor;
use qudi_layers::resample::{pixel_unshuffle, shrink, upsample2};

/// The level that images are given around: the middle of usual exposures.
pub(super) const MIDDLE: f32 = 0.45;

/// Side of the blocks of the local mean, in pixels: the number that frames are multiples of.
const BLOCK: usize = FOLD << (LEVELS - 1);

/// The measurement at half the resolution.
#[derive(Clone, Debug)]
pub(super) struct Measurement {
    /// Linear estimate in image units, `[images, 4, h, w]`.
    pub(super) linear: Tensor<4>,
    /// Linear estimate and counts around zero, `[images, 8, h, w]`.
    pub(super) planes: Tensor<4>,
    /// Linear estimate averaged over blocks of 8 x 8 pixels, `[images, 1, H, W]`: the brightness that the
    /// pre-denoiser starts from.
    pub(super) local_mean: Tensor<4>,
    /// The sensor's numbers, `[images, 11, 1, 1]`.
    pub(super) sensor: Tensor<4>,
    /// Variance of the linear estimate's noise in image units, `[images, 1, 1, 1]`.
    pub(super) noise_variance: Tensor<4>,
    /// Sigma of the errors that fused frames usually have, in [-1, 1]: `[images, 1, 1, 1]`.
    pub(super) error_sigma: Tensor<4>,
}

impl Measurement {
    pub(super) fn new(conditioning: &Conditioning) -> Self {
        let Conditioning { counts, linear_estimate, sensor, frames, .. } = conditioning;
        let images = counts.dims()[0];
        let [bursts, numbers] = sensor.dims();
        let mut local_mean = shrink(linear_estimate.clone(), BLOCK);
        for _ in 0..BLOCK.ilog2() {
            local_mean = upsample2(local_mean);
        }
        let linear = pixel_unshuffle(linear_estimate.clone(), FOLD);
        let counts = pixel_unshuffle(counts.clone(), FOLD);
        let planes = Tensor::cat(vec![(linear.clone() - MIDDLE) * 2.0, counts * 2.0 - 1.0], 1);
        let sensor = sensor.clone().reshape([bursts, 1, numbers]).repeat_dim(1, *frames);
        let noise_variance = conditioning.noise_variance();
        Self {
            linear,
            planes,
            local_mean,
            sensor: sensor.reshape([images, numbers, 1, 1]),
            error_sigma: usual_error(noise_variance.clone()),
            noise_variance,
        }
    }

    /// Returns the same outside autodiff.
    pub(super) fn inner(&self) -> Self {
        let inner = |x: &Tensor<4>| x.clone().inner();
        Self {
            linear: inner(&self.linear),
            planes: inner(&self.planes),
            local_mean: inner(&self.local_mean),
            sensor: inner(&self.sensor),
            noise_variance: inner(&self.noise_variance),
            error_sigma: inner(&self.error_sigma),
        }
    }
}

/// Sigma of usual errors in [-1, 1] from the variance of the linear estimate's noise in image units. Only a
/// scale: 25 dB where the noise is 0.36 (3.25 PPP of `qudi-paper`), 33 dB where it is 0.1 (26 PPP).
fn usual_error(variance: Tensor<4>) -> Tensor<4> {
    const AT_UNIT_NOISE: f32 = 0.2;
    const POWER: f32 = 0.6;
    /// Saturated sensors have little noise, and restored frames errors all the same.
    const RANGE: [f32; 2] = [0.04, 0.4];
    (variance.powf_scalar(POWER / 2.0) * AT_UNIT_NOISE).clamp(RANGE[0], RANGE[1])
}
