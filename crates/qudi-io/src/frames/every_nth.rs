//! Frames of which each is stored several times.

use super::count_frames::CountFrames;
use qudi_core::{Result, Size};
use std::ops::Range;

pub(crate) struct EveryNth {
    frames: Box<dyn CountFrames>,
    times: u64,
    /// How often the first frame is stored, up to `times`.
    first: u64,
}

impl EveryNth {
    pub(crate) fn new(frames: Box<dyn CountFrames>, times: u64, first: u64) -> Self {
        Self { frames, times, first }
    }

    /// Returns the first stored frame that shows frame `frame`.
    fn stored(&self, frame: u64) -> u64 {
        if frame == 0 { 0 } else { self.first + (frame - 1) * self.times }
    }

    /// Returns the frame that stored frame `stored` shows.
    pub(crate) fn holding(&self, stored: u64) -> u64 {
        if stored < self.first { 0 } else { 1 + (stored - self.first) / self.times }
    }

    /// Returns the number of frames among the first `stored` ones.
    pub(crate) fn among(&self, stored: u64) -> u64 {
        if stored == 0 { 0 } else { 1 + stored.saturating_sub(self.first).div_ceil(self.times) }
    }
}

impl CountFrames for EveryNth {
    fn frames(&self) -> u64 {
        self.among(self.frames.frames())
    }

    fn size(&self) -> Size {
        self.frames.size()
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        let stored = self.stored(frame);
        self.frames.read(stored, counts)
    }

    fn add(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        for frame in frames {
            let stored = self.stored(frame);
            self.frames.add(stored..stored + 1, sums)?;
        }
        Ok(())
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.frames.ignore(pixels);
    }

    fn forward_only(&self) -> bool {
        self.frames.forward_only()
    }
}
