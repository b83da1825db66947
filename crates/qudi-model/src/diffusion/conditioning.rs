//! The inputs of the diffusion that come from the measurement.

use crate::sensor::MEAN_LIGHT_SIGMA;
use burn::tensor::Tensor;
use qudi_burst::BurstMotion;
use std::sync::Arc;

/// The least variance: below it, float arithmetic is the noise.
const MIN_VARIANCE: f32 = 1e-8;

/// The inputs of the network that come from the measurement, the same in every reverse step.
///
/// # Shapes
/// - counts, linear_estimate: `[bursts * frames, 1, height, width]`
/// - sensor: `[bursts, 11]`
/// - response: `[bursts, 257]`
#[derive(Clone, Debug)]
pub struct Conditioning {
    /// Counts of each frame over full scale.
    pub counts: Tensor<4>,
    /// Linear estimate of each frame from its own counts, in image units.
    pub linear_estimate: Tensor<4>,
    /// The sensor and its light in numbers ([`sensor_numbers`](crate::sensor::sensor_numbers)).
    pub sensor: Tensor<2>,
    /// Images of mean counts ([`response_levels`](crate::sensor::response_levels)).
    pub response: Tensor<2>,
    /// Frames of a burst.
    pub frames: usize,
    /// Finders of the motion in the counts, one for every burst. Without them, networks follow their learnt
    /// flow.
    pub motion: Vec<Arc<BurstMotion>>,
}

impl Conditioning {
    /// Computes the variance of the linear estimate's noise at the mean light, from the numbers of each
    /// burst's sensor.
    ///
    /// # Shapes
    /// - result: `[bursts * frames, 1, 1, 1]`
    pub fn noise_variance(&self) -> Tensor<4> {
        let [bursts, _] = self.sensor.dims();
        let log_sigma = self.sensor.clone().narrow(1, MEAN_LIGHT_SIGMA, 1).detach();
        let variance = (log_sigma * (2.0 * std::f32::consts::LN_10)).exp().clamp_min(MIN_VARIANCE);
        variance.repeat_dim(1, self.frames).reshape([bursts * self.frames, 1, 1, 1])
    }

    /// Returns the inputs of image `number` alone, as a burst of one frame.
    #[must_use]
    pub fn image(&self, number: usize) -> Self {
        let one = |images: &Tensor<4>| images.clone().narrow(0, number, 1);
        Self {
            counts: one(&self.counts),
            linear_estimate: one(&self.linear_estimate),
            sensor: self.sensor.clone().narrow(0, number / self.frames, 1),
            response: self.response.clone().narrow(0, number / self.frames, 1),
            frames: 1,
            motion: Vec::new(),
        }
    }

    /// Returns the same inputs outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        Self {
            counts: self.counts.clone().inner(),
            linear_estimate: self.linear_estimate.clone().inner(),
            sensor: self.sensor.clone().inner(),
            response: self.response.clone().inner(),
            frames: self.frames,
            motion: self.motion.clone(),
        }
    }
}
