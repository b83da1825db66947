//! The sensor's forward model: every estimate is measured again, under light that grows as the estimate gets
//! certain (docs/network.md, "Sampling").

use crate::counts::{CountPlanes, CountResponse};
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use crate::sensor::dark_per_frame;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{Defects, FullWell, Gain, Response, Sensor};
use qudi_core::{Camera, Frame, Light, Result, Size};

/// Factor by which the light of the last step exceeds the light of the capture.
const GROWTH: f64 = 10.0;

/// The sensor and the light of the forward model at one timestep.
#[derive(Clone, Debug)]
pub struct ForwardModel {
    sensor: Sensor,
    light: Light,
}

impl ForwardModel {
    /// Returns the forward model at a timestep.
    ///
    /// Light, and with it gain and full well, grow by `GROWTH^(1 - t / T)`, so that nothing saturates that
    /// did not in the capture. Sums of binary frames keep their light and get more frames instead.
    pub fn new(acquisition: &Acquisition, timestep: usize) -> Self {
        let factor = GROWTH.powf(1.0 - timestep as f64 / NUM_TIMESTEPS as f64);
        let mut sensor = acquisition.sensor.clone();
        // Damaged pixels are repaired in what the network sees; only the law of an ordinary one counts.
        sensor.defects = Defects::default();
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
        Self { sensor, light: Light { ppp, mean_level: acquisition.mean_level } }
    }

    /// Measures `frames`, row-major images in [0, 1] of `size`. Frame `i` is number `first + i` of the
    /// capture; its photons depend on that number and the seed alone.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the sensor or its light is impossible.
    pub fn measure(
        &self,
        frames: &[f32],
        size: Size,
        first: u64,
        seed: u64,
    ) -> Result<CountPlanes> {
        let mut camera = Camera::new(&self.sensor, size, self.light, seed)?;
        let photons_per_unit = self.light.ppp / self.light.mean_level;
        let dark = dark_per_frame(&self.sensor);
        let response = CountResponse::new(&self.sensor, photons_per_unit, camera.gain(), dark);
        let mut planes = CountPlanes {
            y: Vec::with_capacity(frames.len()),
            u: Vec::with_capacity(frames.len()),
        };
        for (number, image) in (first..).zip(frames.chunks_exact(size.pixels())) {
            let frame = Frame { size, data: image.to_vec() };
            response.append(&camera.expose(number, &[&frame])?, &mut planes);
        }
        Ok(planes)
    }
}
