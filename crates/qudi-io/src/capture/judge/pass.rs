//! The pass over the stored frames that are judged.

use super::counter::{Edges, Stored};
use super::frame_statistics::{Blocks, FrameStatistics};
use super::scene_changes::{Change, Groups, most_likely_place};
use crate::capture::Capture;
use qudi_core::Result;
use rayon::prelude::*;
use std::ops::Range;

/// Bytes that are read at once.
const PIECE_BYTES: usize = 1 << 20;

impl Capture {
    /// Looks at stored frames: numbers of each, their blocks in groups, and where counters are.
    pub(super) fn look_at(
        &mut self,
        frames: Range<u64>,
    ) -> Result<(Vec<FrameStatistics>, Groups, Edges)> {
        let mut groups = Groups::new((frames.end - frames.start) as usize);
        let (mut seen, mut edges) = (Vec::new(), Edges::default());
        self.for_each(frames, |frame, blocks, stored| {
            seen.push(frame);
            groups.push(&blocks);
            edges.push(stored);
        })?;
        Ok((seen, groups, edges))
    }

    /// Looks at each of the stored frames, without unpacking packed ones.
    fn for_each(
        &mut self,
        frames: Range<u64>,
        mut take: impl FnMut(FrameStatistics, Blocks, Stored<'_>),
    ) -> Result<()> {
        let size = self.native.size();
        let frame_bytes = size.height * size.width.div_ceil(8);
        let mut is_packed = self.info.packing.is_some();
        let (mut bytes, mut counts) = (Vec::new(), Vec::new());
        let mut next = frames.start;
        while next < frames.end {
            let at_once = if is_packed { frame_bytes } else { 2 * size.pixels() };
            let n = ((PIECE_BYTES / at_once).max(1) as u64).min(frames.end - next);
            bytes.resize(if is_packed { n as usize * frame_bytes } else { 0 }, 0);
            if is_packed && !self.native.copy_packed(next, &mut bytes)? {
                is_packed = false;
                continue;
            }
            if is_packed {
                let looks = bytes.par_chunks_exact(frame_bytes);
                let looks = looks.map(|frame| FrameStatistics::of_packed(frame, size));
                let looks: Vec<_> = looks.collect();
                for ((frame, blocks), bytes) in looks.into_iter().zip(bytes.chunks(frame_bytes)) {
                    take(frame, blocks, Stored::Packed(bytes, size));
                }
            } else {
                counts.resize(n as usize * size.pixels(), 0);
                for (number, counts) in (next..).zip(counts.chunks_exact_mut(size.pixels())) {
                    self.native.read(number, counts)?;
                }
                let looks = counts.par_chunks_exact(size.pixels());
                let looks: Vec<_> = looks.map(|frame| FrameStatistics::of(frame, size)).collect();
                for ((frame, blocks), counts) in looks.into_iter().zip(counts.chunks(size.pixels()))
                {
                    take(frame, blocks, Stored::Counts(counts));
                }
            }
            next += n;
        }
        Ok(())
    }

    /// Returns the number of frames between `first` and a change, among `frames` frames.
    pub(super) fn place_of(&mut self, change: Change, first: u64, frames: usize) -> Result<u64> {
        let near = change.at.saturating_sub(change.reach)..(change.at + change.reach).min(frames);
        let mut counts = Vec::with_capacity(near.len());
        let stored = first + near.start as u64..first + near.end as u64;
        self.for_each(stored, |_, Blocks(blocks), _| counts.push(blocks.map(f64::from)))?;
        Ok((near.start + most_likely_place(&counts)) as u64)
    }
}
