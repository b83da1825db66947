//! Scaled mean of the window: the naive baseline. It does not invert the sensor's response or subtract dark
//! counts, and motion blurs.

use crate::moving_sums::moving_sums;
use qudi_core::Frame;
use qudi_core::Result;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::CountLaw;

/// Mean of 11 frames, scaled to image units.
#[derive(Clone, Copy, Debug, Default)]
pub struct Average;

/// Number of frames averaged.
const WINDOW: usize = 11;

impl Restorer for Average {
    fn name(&self) -> &'static str {
        "average"
    }

    fn window(&self) -> usize {
        WINDOW
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        let law = CountLaw::new(&acquisition.sensor, acquisition.gain);
        let detections = acquisition.sensor.quantum_efficiency * acquisition.ppp
            + acquisition.sensor.dark_per_frame()?;
        // Mean count per unit of image value.
        let per_unit = (law.mean(detections) - acquisition.pedestal) / acquisition.mean_level;
        let mut frames = Vec::with_capacity(burst.frames.len());
        moving_sums(burst, WINDOW / 2, |sums, n| {
            let scale = 1.0 / (per_unit * f64::from(n));
            let pedestal = acquisition.pedestal * f64::from(n);
            let data = sums.iter().map(|&sum| ((f64::from(sum) - pedestal) * scale) as f32);
            let data = data.collect();
            frames.push(Frame { size: burst.size, data });
        });
        Ok(Restored::gray(frames, None).only(numbers))
    }
}
