//! The sensor inside the loop: every estimate is measured again, under light that grows as the estimate gets
//! certain (DESIGN 4.5).

use crate::measurement::{CountResponse, Planes, dark};
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{FullWell, Gain, Response, Sensor};
use qudi_core::{Camera, Frame, Light, Result, Size};

/// How much more light than the capture's the last step may use.
const GROWTH: f64 = 10.0;

/// The sensor as the loop simulates it at one diffusion time.
#[derive(Clone, Debug)]
pub struct LoopSensor {
    sensor: Sensor,
    light: Light,
}

impl LoopSensor {
    /// The sensor at diffusion time `time` of `times`: light, and with it gain and full well, follow
    /// `GROWTH^(1 - time / times)`, so that nothing saturates that did not. Sums of binary frames keep their light
    /// and get more frames instead.
    pub fn at(acquisition: &Acquisition, time: usize, times: usize) -> Self {
        let factor = GROWTH.powf(1.0 - time as f64 / times as f64);
        let mut sensor = acquisition.sensor.clone();
        // Damaged pixels are repaired in what the network sees; only the law of an ordinary one counts.
        sensor.defects = qudi_core::sensor::Defects::default();
        let mut ppp = acquisition.ppp;
        match sensor.response {
            Response::Linear => {
                ppp *= factor;
                sensor.gain = Gain::Fixed(acquisition.gain / factor);
                sensor.full_well = FullWell::new(sensor.full_well.electrons() * factor);
            }
            Response::Binary => {
                let before = f64::from(sensor.frames_summed);
                let after = (before * factor).round().max(1.0);
                sensor.frames_summed = after as u32;
                ppp *= after / before;
            }
        }
        Self { sensor, light: Light { ppp, exposure: acquisition.exposure } }
    }

    /// Measures `frames`, row-major images in [0, 1] of `size`; frame `i` is number `first + i` of the capture. The
    /// photons depend on seed and frame number alone.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the sensor or its light is impossible.
    pub fn measure(&self, frames: &[f32], size: Size, first: u64, seed: u64) -> Result<Planes> {
        let mut camera = Camera::new(&self.sensor, size, self.light, seed)?;
        let photons_per_unit = self.light.ppp / self.light.exposure;
        let dark = dark(&self.sensor);
        let response = CountResponse::new(&self.sensor, photons_per_unit, camera.gain(), dark);
        let mut planes =
            Planes { y: Vec::with_capacity(frames.len()), u: Vec::with_capacity(frames.len()) };
        for (number, image) in (first..).zip(frames.chunks_exact(size.pixels())) {
            let frame = Frame { size, data: image.to_vec() };
            response.add(&camera.expose(number, &[&frame])?, &mut planes);
        }
        Ok(planes)
    }
}
