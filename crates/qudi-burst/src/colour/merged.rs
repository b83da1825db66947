//! Counts of all frames of a window, added along the motion for each colour by itself.

use super::guided::gaussian;
use super::motion::Displaced;
use super::{CountResponse, Exposures};
use qudi_core::Size;
use qudi_core::colour::Colour;
use qudi_core::restorer::Acquisition;

/// Difference of the logarithms of luma at which a displaced count has lost much of its weight.
const MISFIT: f32 = 0.3;

/// Luma, in units of its mean, below which differences are noise.
const DARK_LUMA: f32 = 0.05;

/// Least weight of the counts around a pixel that tell its colour.
const MIN_WEIGHT: f32 = 1e-3;

/// Sums of counts and of their weights for each colour, at the pixels of one frame.
pub(super) struct MergedColours {
    pub(super) size: Size,
    pub(super) counts: [Vec<f32>; 4],
    pub(super) weights: [Vec<f32>; 4],
}

impl MergedColours {
    /// Adds the counts of all exposures, each frame displaced to the frame that is looked for. Counts whose
    /// luma does not fit there get little weight. `mean` is the mean of luma.
    pub(super) fn new(
        exposures: &Exposures<'_>,
        acquisition: &Acquisition,
        response: &CountResponse,
        displaced: &[Displaced<'_>],
        mean: f32,
    ) -> Self {
        let size = exposures.size;
        let zeros = || std::array::from_fn(|_| vec![0.0f32; size.pixels()]);
        let mut merged = Self { size, counts: zeros(), weights: zeros() };
        let floor = DARK_LUMA * mean;
        let slope = response.at(mean, response.dark).slope / response.per_unit;
        let typical = f64::from(response.dark);
        for (t, displaced) in displaced.iter().enumerate() {
            for i in 0..size.pixels() {
                let (place, [here, there]) = displaced.place(i % size.width, i / size.width);
                let misfit =
                    ((here.max(0.0) + floor) / (there.max(0.0) + floor)).ln() * (1.0 / MISFIT);
                // Dark counts of this pixel that an ordinary one has not.
                let excess = (acquisition.dark_of(i, typical) - typical) as f32;
                let weight = (-0.5 * misfit * misfit).exp();
                for exposure in &exposures.each {
                    let count = f32::from(exposure.frames[t][i]) - slope * excess;
                    merged.add(exposure.filter.colours()[i], place, count, weight);
                }
            }
        }
        merged
    }

    /// Divides a count among the four pixels around `place`.
    fn add(&mut self, colour: Colour, [x, y]: [f32; 2], count: f32, weight: f32) {
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        for (row, wy) in [(top, 1.0 - fy), (top + 1.0, fy)] {
            for (column, wx) in [(left, 1.0 - fx), (left + 1.0, fx)] {
                let inside = row >= 0.0
                    && column >= 0.0
                    && row < self.size.height as f32
                    && column < self.size.width as f32;
                if inside {
                    let i = row as usize * self.size.width + column as usize;
                    let share = weight * wx * wy;
                    self.counts[colour as usize][i] += share * count;
                    self.weights[colour as usize][i] += share;
                }
            }
        }
    }

    /// Returns the light of `colour` at every pixel, from the counts around it; `otherwise` where there are
    /// none.
    pub(super) fn light(
        &self,
        colour: usize,
        response: &CountResponse,
        sigma: f32,
        otherwise: f32,
    ) -> Vec<f32> {
        let counts = gaussian(&self.counts[colour], self.size, sigma);
        let weights = gaussian(&self.weights[colour], self.size, sigma);
        let light = |(count, weight): (&f32, &f32)| {
            if *weight < MIN_WEIGHT {
                return otherwise;
            }
            response.image(count / weight).max(0.0)
        };
        counts.iter().zip(&weights).map(light).collect()
    }

    /// Returns the mean of `luma` over the counts of `colour` around every pixel.
    pub(super) fn luma(&self, colour: usize, luma: &[f32], sigma: f32) -> Vec<f32> {
        let weighted: Vec<f32> =
            self.weights[colour].iter().zip(luma).map(|(weight, luma)| weight * luma).collect();
        let sums = gaussian(&weighted, self.size, sigma);
        let weights = gaussian(&self.weights[colour], self.size, sigma);
        let mean = |((sum, weight), luma): ((&f32, &f32), &f32)| {
            if *weight < MIN_WEIGHT { *luma } else { sum / weight }
        };
        sums.iter().zip(&weights).zip(luma).map(mean).collect()
    }
}
