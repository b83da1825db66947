//! Alignment of blocks of frames with one reference frame (Ma et al. 2020, section 5.1).

use super::patch_matching::align;
use super::pyramid::Pyramid;
use crate::merge::blocks::Blocks;
use crate::patch::PatchMotion;
use crate::prepared_burst::PreparedBurst;
use qudi_core::Frame;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// Aligns the blocks of a window of counts.
#[derive(Debug)]
pub(crate) struct BlockAligner {
    /// Frames per block; odd.
    block_length: usize,
    /// Pyramids of single frames, for blocks of one frame.
    pyramids: Vec<Pyramid>,
}

impl BlockAligner {
    /// Prepares the alignment of blocks of `block_length` frames, which is odd.
    pub(crate) fn new(burst: &PreparedBurst, block_length: usize) -> Self {
        let frames = if block_length == 1 { burst.frames.as_slice() } else { &[] };
        Self { block_length, pyramids: frames.par_iter().map(Pyramid::new).collect() }
    }

    /// Divides the window into blocks around frame `reference`, and finds the motion of every patch to every
    /// frame; where the blocks lie wholly outside `frames` it is left at zero.
    pub(crate) fn align(
        &self,
        burst: &PreparedBurst,
        reference: usize,
        frames: &Range<usize>,
    ) -> (Blocks, PatchMotion) {
        let blocks = Blocks::around(reference, burst.frames.len(), self.block_length);
        let variance = burst.matching_variance(reference, 1.0);
        let pyramid = |k| self.pyramid(burst, &blocks, k);
        // The motion to a frame may lie between the motions to two blocks.
        let half = self.block_length / 2;
        let frames = frames.start.saturating_sub(half)..frames.end + half;
        let patches = burst.grid.len();
        let motion = align_blocks(&blocks, reference, variance, patches, &frames, pyramid);
        (blocks, motion)
    }

    /// Returns the pyramid of the mean of block `k`.
    fn pyramid(&self, burst: &PreparedBurst, blocks: &Blocks, k: usize) -> Cow<'_, Pyramid> {
        let range = blocks.ranges[k].clone();
        if let [pyramid] = self.pyramids.get(range.clone()).unwrap_or_default() {
            return Cow::Borrowed(pyramid);
        }
        let mut mean = Frame::filled(burst.padded_size(), 0.0);
        let share = 1.0 / range.len() as f32;
        for frame in &burst.frames[range] {
            for (sum, count) in mean.data.iter_mut().zip(&frame.data) {
                *sum += share * count;
            }
        }
        Cow::Owned(Pyramid::new(&mean))
    }
}

/// Matches all patches of the reference block in the other blocks that hold some of `frames`, and
/// interpolates their motion to all frames. `variance` is the variance of the difference of two matched
/// pixels of single frames.
pub(crate) fn align_blocks<'a>(
    blocks: &Blocks,
    reference: usize,
    variance: f32,
    patches: usize,
    frames: &Range<usize>,
    pyramid: impl Fn(usize) -> Cow<'a, Pyramid> + Sync,
) -> PatchMotion {
    let own = pyramid(blocks.reference);
    let to_blocks: PatchMotion = (0..blocks.ranges.len())
        .into_par_iter()
        .map(|k| {
            let range = &blocks.ranges[k];
            let is_far = range.end <= frames.start || range.start >= frames.end;
            if k == blocks.reference || is_far {
                return vec![[0.0; 2]; patches];
            }
            align(&own, &pyramid(k), (variance / range.len() as f32).max(1e-6))
        })
        .collect();
    blocks.interpolate(&to_blocks, reference)
}
