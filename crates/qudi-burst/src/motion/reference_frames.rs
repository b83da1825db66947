//! Estimates of all frames of a window, on which motion is found again. They show positions and misfits much
//! better than noisy counts do.

use super::block_alignment::align_blocks;
use super::global_motion::GlobalMotion;
use super::pyramid::Pyramid;
use crate::merge::blocks::Blocks;
use crate::merge::cubic::cubic_within;
use crate::patch::{Patch, PatchMotion};
use crate::prepared_burst::PreparedBurst;
use qudi_core::Frame;
use rayon::prelude::*;
use std::borrow::Cow;

/// Variance of the frames' errors for the estimation of global motion, in units of the counts' variance. It
/// is small because global motion uses squares of many pixels.
const GLOBAL_MOTION_ERROR: f32 = 0.05;

/// Estimates of the mean counts of all frames of a window.
#[derive(Debug)]
pub(crate) struct ReferenceFrames {
    /// Mean counts, of the size of the padded frames.
    pub(crate) frames: Vec<Frame>,
    /// Variance of the estimates' errors, in units of the counts' variance.
    pub(crate) error_variance: f32,
    /// Pyramids of the estimates.
    pub(crate) pyramids: Vec<Pyramid>,
    /// Motion of most of the image; `None` if frames are too few or too small.
    pub(crate) global_motion: Option<GlobalMotion>,
}

impl ReferenceFrames {
    /// Prepares estimates of the mean counts of `burst`, whose errors have `error_variance` times the counts'
    /// variance.
    pub(crate) fn new(burst: &PreparedBurst, frames: Vec<Frame>, error_variance: f32) -> Self {
        let pyramids = frames.par_iter().map(Pyramid::new).collect();
        let global_motion = GlobalMotion::find(&frames, &burst.moments, GLOBAL_MOTION_ERROR);
        Self { frames, error_variance, pyramids, global_motion }
    }

    /// Matches every patch of frame `reference` in every frame.
    pub(crate) fn align(&self, burst: &PreparedBurst, reference: usize) -> PatchMotion {
        let blocks = Blocks::around(reference, self.frames.len(), 1);
        let pyramid = |k: usize| Cow::Borrowed(&self.pyramids[k]);
        let variance = burst.matching_variance(reference, self.error_variance);
        let all = 0..self.frames.len();
        align_blocks(&blocks, reference, variance, burst.grid.len(), &all, pyramid)
    }

    /// Samples patch `i` of `image`, displaced by `d`, with cubic convolution. Pixels outside the image are
    /// taken from the estimate of frame `reference`.
    pub(crate) fn sample(
        &self,
        burst: &PreparedBurst,
        image: &Frame,
        i: usize,
        d: [f32; 2],
        reference: usize,
    ) -> Patch {
        let corner = burst.grid.corner(i);
        let at = [corner[0] as f32 + d[0], corner[1] as f32 + d[1]];
        cubic_within(image, at, &self.frames[reference], corner)
    }
}
