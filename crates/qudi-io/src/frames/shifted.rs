//! Values whose lowest bits are empty: counts stored at the upper end of their words.

use super::count_frames::CountFrames;
use qudi_core::{Result, Size};

pub(crate) struct Shifted {
    frames: Box<dyn CountFrames>,
    bits: u32,
}

impl Shifted {
    /// Drops the lowest `bits` of all values.
    pub(crate) fn new(frames: Box<dyn CountFrames>, bits: u32) -> Self {
        Self { frames, bits }
    }
}

impl CountFrames for Shifted {
    fn frames(&self) -> u64 {
        self.frames.frames()
    }

    fn size(&self) -> Size {
        self.frames.size()
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        self.frames.read(frame, counts)?;
        for count in counts.iter_mut() {
            *count >>= self.bits;
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
