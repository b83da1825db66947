//! The brightness that networks trained here give back.
//!
//! Their authors trained each network at one light level, where one gain and one dark level lead from counts
//! to images. At several light levels there is none: the light of a burst, and the mean level of its scene,
//! do not show in counts over full scale. What counts do show is what they are on average. That is the target
//! here, and restoring, which knows sensor, light and mean level of the acquisition, goes back to the units
//! of the image.

use qudi_core::restorer::Acquisition;

/// Largest target, twice full scale: counts say nothing about brighter places.
const MAX_TARGET: f32 = 2.0;

/// From image values to expected counts over full scale, where the sensor does not saturate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExpectedCounts {
    /// Of black: dark counts; 0 of a sensor that does not say.
    black: f32,
    /// Of white, more than of black.
    white: f32,
}

impl ExpectedCounts {
    /// Computes the expected counts of an acquisition.
    pub fn of(acquisition: &Acquisition) -> Self {
        let sensor = &acquisition.sensor;
        let of_electron = acquisition.gain / f64::from(sensor.max_count());
        let of_white = sensor.quantum_efficiency * acquisition.photons_per_unit();
        let black = sensor.dark_per_frame().unwrap_or(0.0) * of_electron;
        Self { black: black as f32, white: (of_white * of_electron) as f32 }
    }

    /// Returns the target for an image value.
    pub fn target(self, value: f32) -> f32 {
        (self.black + self.white * value).min(MAX_TARGET)
    }

    /// Returns the image value of a target.
    pub fn image(self, target: f32) -> f32 {
        (target - self.black) / self.white
    }
}
