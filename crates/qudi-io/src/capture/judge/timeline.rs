//! The light and the changes of a capture over time.

use super::scene_changes::{Groups, difference, total};
use qudi_core::Size;
use serde::Serialize;

/// Points of a stretch.
const MAX_POINTS: usize = 300;

/// Consecutive frames that were looked at, in steps of equal length.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stretch {
    /// First frame.
    pub first: u64,
    /// Frames of a step.
    pub step: u64,
    /// Mean count per pixel and frame in each step.
    pub light: Vec<f64>,
    /// Change of the picture since the step before, over what chance explains.
    pub change: Vec<f64>,
}

impl Stretch {
    /// Summarizes `frames` frames of `size` from `first` on.
    pub(super) fn new(first: u64, frames: usize, groups: &Groups, size: Size) -> Self {
        let merged = groups.counts.len().div_ceil(MAX_POINTS);
        let steps: Vec<_> = groups.counts.chunks(merged).map(total).collect();
        let step = merged * groups.length;
        let pixels = size.pixels() as f64;
        let held = |n: usize| step.min(frames - n * step) as f64;
        let light = steps.iter().enumerate();
        let light = light.map(|(n, counts)| counts.iter().sum::<f64>() / pixels / held(n));
        let change = steps.windows(2).map(|pair| difference(&pair[0], &pair[1])[0]);
        Self {
            first,
            step: step as u64,
            light: light.collect(),
            change: [0.0].into_iter().chain(change).collect(),
        }
    }

    /// Returns one past the last frame, at most.
    pub fn end(&self) -> u64 {
        self.first + self.step * self.light.len() as u64
    }
}
