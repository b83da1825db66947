//! Counts of a window, prepared for alignment and merging.

use crate::merge::hot_pixels::HotPixels;
use crate::motion::grid::Grid;
use crate::patch::{Patch, padded, padded_size};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::{CountLaw, CountMoments};
use qudi_core::{Frame, Size};
use rayon::prelude::*;
use std::borrow::Borrow;

/// Counts of a window, with hot pixels repaired and small frames padded to one patch.
#[derive(Debug)]
pub(crate) struct PreparedBurst {
    /// Size of the window's frames; `frames` may be larger.
    pub(crate) size: Size,
    /// Counts; frames are at least as large as a patch.
    pub(crate) frames: Vec<Frame>,
    /// Mean and variance of the sensor's counts.
    pub(crate) moments: CountMoments,
    /// Patches of alignment and merging.
    pub(crate) grid: Grid,
}

impl PreparedBurst {
    /// Repairs and pads the frames of `burst`.
    pub(crate) fn new(burst: BurstView<'_>, acquisition: &Acquisition) -> Self {
        let moments = CountMoments::new(&CountLaw::new(&acquisition.sensor, acquisition.gain));
        let size = padded_size(burst.size);
        let hot = HotPixels::find(burst, acquisition.sensor.max_count());
        let repaired = |counts: &Vec<u16>| padded(&hot.repaired(counts), burst.size, size);
        let frames = burst.frames.par_iter().map(repaired).collect();
        Self { size: burst.size, frames, moments, grid: Grid::half_overlapping(size) }
    }

    /// Returns the size of the padded frames.
    pub(crate) fn padded_size(&self) -> Size {
        self.frames[0].size
    }

    /// Blends overlapping patches into a frame of the window's size.
    pub(crate) fn blended<P: Borrow<Patch>>(&self, patch: impl Fn(usize) -> P) -> Frame {
        self.grid.blended(self.padded_size(), self.size, patch)
    }

    /// Crops a padded frame to the window's size.
    pub(crate) fn cropped(&self, frame: &Frame) -> Frame {
        let rows = (0..self.size.height).flat_map(|y| &frame.row(y)[..self.size.width]);
        Frame { size: self.size, data: rows.copied().collect() }
    }

    /// Returns the variance of the difference of two matched pixels of images whose errors have
    /// `error_variance` times the variance of the counts of frame `reference`. It is positive even for images
    /// without noise.
    pub(crate) fn matching_variance(&self, reference: usize, error_variance: f32) -> f32 {
        let single = self.moments.variance_at_mean(self.frames[reference].mean()) as f32;
        (2.0 * (error_variance * single)).max(1e-6)
    }

    /// Returns the variance of a count whose mean is the mean of `patch`.
    pub(crate) fn variance_of(&self, patch: &Patch) -> f32 {
        let pixels = patch.as_flattened().len() as f32;
        let mean = patch.iter().flatten().sum::<f32>() / pixels;
        self.moments.variance_at_mean(f64::from(mean)) as f32
    }
}

/// Lists up to `count` of `frames` frames, nearest to `reference` first, starting with `reference` itself. Of
/// two equally near frames the later one comes first.
pub(crate) fn nearest(frames: usize, reference: usize, count: usize) -> Vec<usize> {
    let mut list: Vec<usize> = (0..frames).collect();
    list.sort_by_key(|&frame| (frame.abs_diff(reference), frame < reference));
    list.truncate(count);
    list
}
