//! The brightness that networks trained here give back.
//!
//! Their authors trained each network at one light level, where one gain leads from counts to images. At several
//! light levels there is none: the light of a burst, and the mean level of its scene, do not show in counts over full
//! scale. What counts do show is the truth in their own units. That is the target here, and restoring, which knows
//! light, gain and mean level of the acquisition, goes back from it to the units of the image.

use qudi_core::restorer::Acquisition;

/// The largest target, twice full scale: counts say nothing about how much brighter a place is.
pub const BRIGHTEST: f32 = 2.0;

/// Expected counts over full scale for an image value of 1, where the sensor does not saturate and nothing is dark.
pub fn counts_per_unit(acquisition: &Acquisition) -> f32 {
    let sensor = &acquisition.sensor;
    let detections = sensor.quantum_efficiency * acquisition.photons_per_unit();
    (acquisition.gain * detections / f64::from(sensor.max_count())) as f32
}
