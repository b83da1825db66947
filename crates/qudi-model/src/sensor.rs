//! The sensor and its light as numbers that the diffusion is given.

use crate::counts::{CountResponse, MAX_IMAGE};
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{CountLaw, CountMoments, Response, Sensor};

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

/// Steps of the table of [`response_levels`], from no count to full scale.
pub(crate) const RESPONSE_STEPS: usize = 256;

/// Values of the table of [`response_levels`].
pub const RESPONSE_LEVELS: usize = RESPONSE_STEPS + 1;

/// Returns the response of one burst, `[1, 257]`.
pub fn response_tensor(acquisition: &Acquisition, device: &Device) -> Tensor<2> {
    let levels = TensorData::new(response_levels(acquisition).to_vec(), [1, RESPONSE_LEVELS]);
    Tensor::from_data(levels, device)
}

/// Tabulates the image at which a mean count is a fraction `k / 256` of full scale: the inverse of the
/// sensor's response with its saturation, at most 2. Below the dark counts it is negative.
pub fn response_levels(acquisition: &Acquisition) -> [f32; RESPONSE_LEVELS] {
    let sensor = &acquisition.sensor;
    let moments = CountMoments::new(&CountLaw::new(sensor, acquisition.gain));
    let light = sensor.quantum_efficiency * acquisition.photons_per_unit();
    let full_scale = f64::from(sensor.max_count());
    std::array::from_fn(|k| {
        let mean = full_scale * k as f64 / RESPONSE_STEPS as f64;
        let detections = moments.detections_at_mean(mean) - dark_per_frame(sensor);
        (detections / light).min(MAX_IMAGE) as f32
    })
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

#[cfg(test)]
mod tests {
    use super::*;

    /// The mean count of every image leads back to it.
    #[test]
    fn levels_invert_the_response() {
        for (name, ppp) in [("qudi-paper", 3.25), ("qudi-paper", 26.0), ("swissspad2", 0.4)] {
            let sensor = Sensor::load(name).unwrap_or_else(|e| panic!("{e}"));
            let acquisition = Acquisition::new(sensor, ppp, 0.45).unwrap_or_else(|e| panic!("{e}"));
            let levels = response_levels(&acquisition);
            let law = CountLaw::new(&acquisition.sensor, acquisition.gain);
            let light = acquisition.sensor.quantum_efficiency * acquisition.photons_per_unit();
            for image in [0.0, 0.1, 0.45, 1.0] {
                let mean = law.mean(image * light + dark_per_frame(&acquisition.sensor));
                let at = mean / f64::from(acquisition.sensor.max_count()) * RESPONSE_STEPS as f64;
                let (low, part) = (at.floor() as usize, at.fract() as f32);
                let got = levels[low] + part * (levels[low + 1] - levels[low]);
                let error = f64::from(got) - image;
                assert!(error.abs() < 5e-3, "{name} at {ppp} PPP: {got} for {image}");
            }
        }
    }
}
