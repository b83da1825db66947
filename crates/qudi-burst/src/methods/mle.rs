//! Maximum-likelihood flux of a moving mean: it inverts the sensor's response and subtracts dark counts. The
//! length of the mean is limited by motion.

use crate::moving_sums::{moving_sums, sure_window_radius};
use qudi_core::Frame;
use qudi_core::Result;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;

/// Maximum-likelihood estimate of the flux over a window of 1 to 11 frames.
#[derive(Clone, Copy, Debug)]
pub struct Mle {
    radius: usize,
}

impl Mle {
    /// Creates an estimate over `radius` frames on either side.
    pub fn new(radius: usize) -> Self {
        Self { radius }
    }

    /// Chooses the length on windows of the clip, with [`sure_window_radius`].
    pub fn choose(samples: &[BurstView<'_>], acquisition: &Acquisition) -> Self {
        Self { radius: sure_window_radius(samples, acquisition, 1.0) }
    }

    /// Returns the number of frames in each sum.
    pub fn length(self) -> usize {
        2 * self.radius + 1
    }
}

impl Restorer for Mle {
    fn name(&self) -> &'static str {
        "mle"
    }

    fn window(&self) -> usize {
        2 * LONGEST_HALF + 1
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        let ordinary = acquisition.sensor.dark_per_frame()?;
        let units = 1.0 / acquisition.photons_per_unit();
        let mut frames = Vec::with_capacity(burst.frames.len());
        moving_sums(burst, self.radius, |sums, n| {
            let pixel = |(i, &sum): (usize, &u32)| {
                let dark = acquisition.dark_of(i, ordinary);
                let (sum, gain) = (f64::from(sum), acquisition.gain);
                let flux = acquisition.sensor.estimate_signed_flux(sum, n, gain, dark);
                // Signed counts give signed values.
                let flux = if acquisition.pedestal > 0.0 { flux } else { flux.max(0.0) };
                (flux * units) as f32
            };
            let data = sums.iter().enumerate().map(pixel).collect();
            frames.push(Frame { size: burst.size, data });
        });
        Ok(Restored::gray(frames, None).only(numbers))
    }
}
