//! Counts in memory, as frames of a capture.

use super::count_frames::CountFrames;
use qudi_core::Result;
use qudi_core::Size;

pub(crate) struct MemoryFrames {
    pub(crate) size: Size,
    pub(crate) frames: Vec<Vec<u16>>,
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
