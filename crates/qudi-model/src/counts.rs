//! The linear estimate of the image from single counts.

use crate::sensor::dark_per_frame;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::{CountLaw, Sensor};

/// The brightest value of any plane in image units: twice white.
pub(crate) const MAX_IMAGE: f64 = 2.0;

/// Counts as the diffusion sees them, frame after frame, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CountPlanes {
    /// Counts over full scale; where a map of dark rates is known, without what a pixel has more than an
    /// ordinary one.
    pub y: Vec<f32>,
    /// The linear estimate in image units, in [0, 2].
    pub u: Vec<f32>,
}

impl CountPlanes {
    /// Computes the planes of a captured burst.
    pub fn new(burst: BurstView<'_>, acquisition: &Acquisition) -> Self {
        let response = CountResponse::new(
            &acquisition.sensor,
            acquisition.photons_per_unit(),
            acquisition.gain,
            dark_per_frame(&acquisition.sensor),
        );
        let mut planes = Self::default();
        for counts in burst.frames {
            match &acquisition.dark {
                None => response.append(counts, &mut planes),
                Some(map) => {
                    let ordinary = dark_per_frame(&acquisition.sensor);
                    for (&count, &dark) in counts.iter().zip(map) {
                        let excess = response.fraction(f64::from(dark) - ordinary);
                        planes.y.push((response.of(count).0 - excess).clamp(0.0, 1.0));
                        planes.u.push(response.estimate(count, f64::from(dark)));
                    }
                }
            }
        }
        planes
    }

    /// Appends the frames of other planes.
    pub fn extend(&mut self, more: Self) {
        self.y.extend(more.y);
        self.u.extend(more.u);
    }

    /// Changes both planes by `f`.
    #[must_use]
    pub fn map(&self, f: impl Fn(&[f32]) -> Vec<f32>) -> Self {
        Self { y: f(&self.y), u: f(&self.u) }
    }
}

/// Linear estimates from the counts of a sensor under a certain light.
#[derive(Clone, Debug)]
pub struct CountResponse<'a> {
    sensor: &'a Sensor,
    photons_per_unit: f64,
    gain: f64,
    /// Count over full scale, and linear estimate of an ordinary pixel, by count.
    table: Vec<(f32, f32)>,
}

impl<'a> CountResponse<'a> {
    /// Tabulates the response of pixels with `dark` electrons per output frame.
    pub fn new(sensor: &'a Sensor, photons_per_unit: f64, gain: f64, dark: f64) -> Self {
        let mut response = Self { sensor, photons_per_unit, gain, table: Vec::new() };
        let full_scale = f32::from(sensor.max_count());
        let entry = |count| (f32::from(count) / full_scale, response.estimate(count, dark));
        response.table = (0..=sensor.max_count()).map(entry).collect();
        response
    }

    /// Computes the linear estimate from one count, in image units.
    fn estimate(&self, count: u16, dark: f64) -> f32 {
        let photons = self.sensor.estimate_flux(f64::from(count), 1, self.gain, dark);
        (photons / self.photons_per_unit).min(MAX_IMAGE) as f32
    }

    /// Returns so many detections as a fraction of full scale.
    fn fraction(&self, detections: f64) -> f32 {
        (detections * self.gain / f64::from(self.sensor.max_count())) as f32
    }

    /// Sigma of the linear estimate at `detections` expected per output frame, from the exact law of the
    /// counts.
    pub(crate) fn linear_sigma(&self, detections: f64) -> f64 {
        let law = CountLaw::new(self.sensor, self.gain).probabilities(detections);
        let values = || law.iter().zip(&self.table).map(|(p, &(_, u))| (p, f64::from(u)));
        let mean: f64 = values().map(|(p, u)| p * u).sum();
        values().map(|(p, u)| p * (u - mean).powi(2)).sum::<f64>().sqrt()
    }

    /// Returns the entry of a count. Counts above full scale, which no such sensor gives, count as full
    /// scale.
    fn of(&self, count: u16) -> (f32, f32) {
        self.table[usize::from(count).min(self.table.len() - 1)]
    }

    /// Appends a frame to planes.
    pub fn append(&self, counts: &[u16], planes: &mut CountPlanes) {
        for &count in counts {
            let (y, u) = self.of(count);
            planes.y.push(y);
            planes.u.push(u);
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use qudi_core::Size;

    #[test]
    fn planes_hold_counts_over_full_scale() {
        let sensor = Sensor::load("qudi-paper").unwrap();
        let gain = sensor.gain_at(3.25).unwrap();
        let mut planes = CountPlanes::default();
        CountResponse::new(&sensor, 7.0, gain, 1.6).append(&[0, 3, 7, 9], &mut planes);
        assert_eq!(planes.y, [0.0, 3.0 / 7.0, 1.0, 1.0]);
        assert_eq!(planes.u[2], planes.u[3]);
    }

    #[test]
    fn linear_estimates_follow_a_dark_map() {
        let sensor = Sensor::load("qudi-paper").unwrap();
        let mut acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap();
        let size = Size { height: 1, width: 4 };
        let frames = [vec![0, 3, 7, 9]];
        let estimates = |acquisition: &Acquisition| {
            CountPlanes::new(BurstView { size, frames: &frames }, acquisition).u
        };
        let flat = estimates(&acquisition);
        assert_eq!(flat[0], 0.0);
        acquisition.dark = Some(vec![0.0, 3.0, 1.6, 1.6]);
        let mapped = estimates(&acquisition);
        assert!(mapped[1] < flat[1]);
        assert_eq!(mapped[2], flat[2]);
    }
}
