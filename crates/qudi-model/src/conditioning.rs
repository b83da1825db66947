//! What the network is given of a burst: named planes of counts and reference estimate, and the sensor in
//! numbers.

mod aligned;
mod count_response;
mod sensor_numbers;

use burn::tensor::Tensor;
use qudi_core::sensor::Sensor;

pub use aligned::{AlignedNeighbours, AlignedPlanes, AlignedTensors};
pub use count_response::{CountPlanes, CountResponse};
pub use sensor_numbers::{MEAN_LIGHT_SIGMA, SENSOR_NUMBERS, sensor_numbers, sensor_tensor};

/// The brightest value of any plane in image units: twice white.
pub(crate) const MAX_IMAGE: f64 = 2.0;

/// Dark electrons per output frame; none where the sensor does not say.
pub(crate) fn dark_per_frame(sensor: &Sensor) -> f64 {
    sensor.dark_per_frame().unwrap_or(0.0)
}

/// The inputs of the network that come from the measurement, the same in every reverse step.
///
/// # Shapes
/// - counts, linear_estimate: `[bursts * frames, 1, height, width]`
/// - sensor: `[bursts, 11]`
#[derive(Clone, Debug)]
pub struct Conditioning {
    /// The counts of each frame over full scale.
    pub counts: Tensor<4>,
    /// The linear estimate of each frame from its own counts, in image units.
    pub linear_estimate: Tensor<4>,
    /// The reference estimate and the aligned neighbours of each frame; none for networks without a
    /// reference estimate.
    pub aligned: Option<AlignedTensors>,
    /// The sensor and its light in numbers ([`sensor_numbers`]).
    pub sensor: Tensor<2>,
    /// The frames of a burst.
    pub frames: usize,
}

/// The least variance: below it, float arithmetic is the noise.
const MIN_VARIANCE: f32 = 1e-8;

impl Conditioning {
    /// The variance of the linear estimate's noise at the mean light, from the numbers of each burst's
    /// sensor.
    ///
    /// # Shapes
    /// - result: `[bursts * frames, 1, 1, 1]`
    pub fn noise_variance(&self) -> Tensor<4> {
        let [bursts, _] = self.sensor.dims();
        let log_sigma = self.sensor.clone().narrow(1, MEAN_LIGHT_SIGMA, 1).detach();
        let variance = (log_sigma * (2.0 * std::f32::consts::LN_10)).exp().clamp_min(MIN_VARIANCE);
        variance.repeat_dim(1, self.frames).reshape([bursts * self.frames, 1, 1, 1])
    }

    /// The inputs of image `number` alone, as a burst of one frame.
    #[must_use]
    pub fn image(&self, number: usize) -> Self {
        let one = |images: Tensor<4>| images.narrow(0, number, 1);
        Self {
            counts: one(self.counts.clone()),
            linear_estimate: one(self.linear_estimate.clone()),
            aligned: self.aligned.as_ref().map(|aligned| aligned.map(one)),
            sensor: self.sensor.clone().narrow(0, number / self.frames, 1),
            frames: 1,
        }
    }

    /// The same inputs outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        Self {
            counts: self.counts.clone().inner(),
            linear_estimate: self.linear_estimate.clone().inner(),
            aligned: self.aligned.as_ref().map(|aligned| aligned.map(Tensor::inner)),
            sensor: self.sensor.clone().inner(),
            frames: self.frames,
        }
    }
}
