//! What the network is given of a burst: named planes of counts and reference estimate, and the sensor in
//! numbers.

mod aligned;
mod count_response;
mod sensor_numbers;

use burn::tensor::Tensor;
use qudi_core::sensor::Sensor;

pub use aligned::{AlignedNeighbours, AlignedPlanes, AlignedTensors};
pub use count_response::{CountPlanes, CountResponse, linear_estimates};
pub use sensor_numbers::{MEAN_LIGHT_SIGMA, SENSOR_NUMBERS, sensor_numbers};

/// The brightest value of any plane in image units: twice white.
pub(crate) const MAX_IMAGE: f64 = 2.0;

/// Dark electrons per output frame; none where the sensor does not say.
pub(crate) fn dark_per_frame(sensor: &Sensor) -> f64 {
    sensor.dark_per_frame().unwrap_or(0.0)
}

/// The inputs of the network that come from the measurement, the same in every reverse step.
///
/// # Shapes
/// - linear_estimate: `[bursts * frames, 1, height, width]`
/// - sensor: `[bursts, 11]`
#[derive(Clone, Debug)]
pub struct Conditioning {
    /// The linear estimate of each frame from its own counts, in image units.
    pub linear_estimate: Tensor<4>,
    /// The reference estimate and the aligned neighbours of each frame.
    pub aligned: AlignedTensors,
    /// The sensor and its light in numbers ([`sensor_numbers`]).
    pub sensor: Tensor<2>,
    /// The frames of a burst.
    pub frames: usize,
}

impl Conditioning {
    /// The same inputs outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        Self {
            linear_estimate: self.linear_estimate.clone().inner(),
            aligned: self.aligned.map(Tensor::inner),
            sensor: self.sensor.clone().inner(),
            frames: self.frames,
        }
    }
}
