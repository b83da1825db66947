//! The sensor and its light as numbers that the diffusion is given.

use crate::counts::CountResponse;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{Response, Sensor};

/// Number of numbers that describe a sensor and its light.
pub const SENSOR_NUMBERS: usize = 11;

/// The place of log10 of the sigma of the linear estimate at the mean light.
pub const MEAN_LIGHT_SIGMA: usize = 10;

/// Returns the dark electrons per output frame; none where the sensor does not say.
pub(crate) fn dark_per_frame(sensor: &Sensor) -> f64 {
    sensor.dark_per_frame().unwrap_or(0.0)
}

/// Returns the numbers of one burst, `[1, 11]`.
pub fn sensor_tensor(acquisition: &Acquisition, device: &Device) -> Tensor<2> {
    let numbers = TensorData::new(sensor_numbers(acquisition).to_vec(), [1, SENSOR_NUMBERS]);
    Tensor::from_data(numbers, device)
}

/// Describes the sensor and its light in numbers (docs/network.md, "Inputs").
pub fn sensor_numbers(acquisition: &Acquisition) -> [f32; SENSOR_NUMBERS] {
    let sensor = &acquisition.sensor;
    let binary = sensor.response == Response::Binary;
    let light = acquisition.photons_per_unit();
    let dark = dark_per_frame(sensor);
    let response = CountResponse::new(sensor, light, acquisition.gain, dark);
    let log_sigma = |image| {
        let detections = sensor.quantum_efficiency * image * light + dark;
        response.linear_sigma(detections).max(1e-4).log10()
    };
    [
        acquisition.ppp.max(1e-6).log10(),
        acquisition.mean_level,
        sensor.quantum_efficiency,
        dark,
        sensor.read_noise,
        acquisition.gain.max(1e-6).log10(),
        (f64::from(sensor.max_count()) + 1.0).log2() / 8.0,
        f64::from(u8::from(binary)),
        f64::from(sensor.frames_summed).log2() / 8.0,
        log_sigma(0.0),
        log_sigma(acquisition.mean_level),
    ]
    .map(|number| number as f32)
}
