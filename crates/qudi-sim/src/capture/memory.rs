//! Counts that are in memory already, as a capture.

use super::count_frames::CountFrames;
use crate::error::Result;
use crate::frame::Size;

pub(super) struct MemoryFrames {
    pub(super) size: Size,
    pub(super) frames: Vec<Vec<u16>>,
}

impl CountFrames for MemoryFrames {
    fn frames(&self) -> u64 {
        self.frames.len() as u64
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        counts.copy_from_slice(&self.frames[frame as usize]);
        Ok(())
    }
}
