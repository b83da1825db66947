//! Consistency of a result with the photons. The restored frames are measured again by the sensor's law
//! and compared with the counts: `chi^2 = (y - E y)^2 / Var y`, 1 on average where the image is
//! right, above 1 where it invents or blurs, below 1 where it follows the noise.

use crate::error::Result;
use crate::frame::{Frame, Size};
use crate::restorer::Acquisition;
use crate::sensor::{CountLaw, CountMoments};

/// Lower bound of the variances (in DN^2) that are used: black pixels of a noiseless sensor have none.
const MIN_VARIANCE: f64 = 1e-6;

/// Reduced chi-square of a restored clip, with a map.
#[derive(Clone, Debug)]
pub struct Consistency {
    moments: CountMoments,
    size: Size,
    map: Vec<f64>,
    frames: u64,
}

impl Consistency {
    /// Creates an empty sum for frames of `size` of the acquisition's sensor.
    pub fn new(size: Size, acquisition: &Acquisition) -> Self {
        let law = CountLaw::new(&acquisition.sensor, acquisition.gain);
        let moments = CountMoments::new(&law);
        Self { moments, size, map: vec![0.0; size.pixels()], frames: 0 }
    }

    /// Compares one frame with its counts, and returns its own mean.
    ///
    /// # Errors
    /// [`Error`](crate::Error) if the sensor's dark rate is unknown.
    pub fn add(
        &mut self,
        restored: &Frame,
        counts: &[u16],
        acquisition: &Acquisition,
    ) -> Result<f64> {
        let typical = acquisition.sensor.dark_per_frame()?;
        let photons = acquisition.photons_per_unit() * acquisition.sensor.quantum_efficiency;
        let mut total = 0.0;
        for (i, (&image, &count)) in restored.data.iter().zip(counts).enumerate() {
            let detections = f64::from(image).max(0.0) * photons + acquisition.dark_of(i, typical);
            let (mean, variance) = self.moments.at(detections);
            if variance > MIN_VARIANCE {
                let chi_square = (f64::from(count) - mean).powi(2) / variance;
                self.map[i] += chi_square;
                total += chi_square;
            }
        }
        self.frames += 1;
        Ok(total / self.map.len() as f64)
    }

    /// Returns the mean over all pixels and frames; `None` before the first frame.
    pub fn chi_square(&self) -> Option<f64> {
        let mean = self.map.iter().sum::<f64>() / self.map.len() as f64;
        (self.frames > 0).then(|| mean / self.frames as f64)
    }

    /// Returns the mean over frames, `[height][width]`.
    pub fn map(&self) -> Frame {
        let scale = 1.0 / self.frames.max(1) as f64;
        let data = self.map.iter().map(|&sum| (sum * scale) as f32).collect();
        Frame { size: self.size, data }
    }
}
