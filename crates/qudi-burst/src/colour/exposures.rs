//! The counts of a capture with colours: behind a filter, or in three full planes.

use qudi_core::Size;
use qudi_core::colour::{Colour, ColourFilter};

/// Counts of every frame, each pixel behind its colour.
pub(super) struct Exposure<'a> {
    pub(super) frames: &'a [Vec<u16>],
    pub(super) filter: &'a ColourFilter,
}

/// Exposures of the same frames: one behind a colour filter array, or one for each colour.
pub(super) struct Exposures<'a> {
    pub(super) size: Size,
    pub(super) each: Vec<Exposure<'a>>,
}

impl Exposures<'_> {
    /// Returns the number of frames.
    pub(super) fn frames(&self) -> usize {
        self.each.first().map_or(0, |exposure| exposure.frames.len())
    }

    /// Returns the mean over exposures of what `of` returns for their filters.
    fn mean<const N: usize>(&self, of: fn(&ColourFilter) -> [f64; N]) -> [f64; N] {
        let mut sum = [0.0; N];
        for exposure in &self.each {
            for (sum, value) in sum.iter_mut().zip(of(exposure.filter)) {
                *sum += value / self.each.len() as f64;
            }
        }
        sum
    }

    /// Returns the share of the counts behind each colour.
    pub(super) fn shares(&self) -> [f64; 4] {
        self.mean(ColourFilter::shares)
    }

    /// Returns the weights of red, green and blue light in luma: the mean of what all pixels see.
    pub(super) fn luma_weights(&self) -> [f32; 3] {
        self.mean(ColourFilter::luma_weights).map(|weight| weight as f32)
    }

    /// Returns the efficiencies of red, green and blue.
    pub(super) fn efficiency(&self) -> [f32; 3] {
        let [red, green, blue, _] = self.mean(ColourFilter::efficiency);
        [red, green, blue].map(|efficiency| efficiency as f32)
    }

    /// Returns the weights of red, green and blue light in what a pixel behind each colour sees.
    pub(super) fn responses(&self) -> [[f32; 3]; 4] {
        let of = |colour| self.each[0].filter.response(colour).map(|weight| weight as f32);
        Colour::ALL.map(of)
    }

    /// Returns the mean count behind each colour, 0 of colours that there are not.
    pub(super) fn means(&self) -> [f32; 4] {
        let (mut sums, mut numbers) = ([0.0f64; 4], [0.0f64; 4]);
        for exposure in &self.each {
            for counts in exposure.frames {
                for (&count, &colour) in counts.iter().zip(exposure.filter.colours()) {
                    sums[colour as usize] += f64::from(count);
                    numbers[colour as usize] += 1.0;
                }
            }
        }
        std::array::from_fn(|k| (sums[k] / numbers[k].max(1.0)) as f32)
    }
}
