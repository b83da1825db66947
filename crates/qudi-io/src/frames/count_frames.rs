//! Frames of photon counts that can be asked for by number.

use qudi_core::Result;
use qudi_core::Size;
use std::ops::Range;

/// A stack of count images, `[frames][height][width]`.
pub trait CountFrames: Send {
    /// Number of frames; of a pipe, those that have arrived.
    fn frames(&self) -> u64;

    /// Number of frames in all; `None` as long as that of a pipe is unknown.
    fn length(&self) -> Option<u64> {
        Some(self.frames())
    }

    /// Waits until there are `frames` frames, or no more come; gives how many there are. What the
    /// user should know of the end goes to `notes`.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the pipe ends inside a frame.
    fn wait_for(&mut self, _frames: u64, _remarks: &mut Vec<String>) -> Result<u64> {
        Ok(self.frames())
    }

    /// Says that no frame before `frame` is asked for again.
    fn discard_before(&mut self, _frame: u64) {}

    /// Size of every frame.
    fn size(&self) -> Size;

    /// Reads frame `frame` into `counts`, row-major.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be read or holds no counts.
    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()>;

    /// Adds the counts of `frames` to `sums`.
    ///
    /// # Errors
    /// As [`CountFrames::read`].
    fn add(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        let mut counts = vec![0; self.size().pixels()];
        for frame in frames {
            self.read(frame, &mut counts)?;
            for (sum, &count) in sums.iter_mut().zip(&counts) {
                *sum += u32::from(count);
            }
        }
        Ok(())
    }

    /// Fills `bytes` with frames from `first` on, rows of whole bytes, 8 pixels each, the first in
    /// the highest bit; `false` if frames are not stored so nearly like that that copying is all.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be read.
    fn copy_packed(&mut self, _first: u64, _bytes: &mut [u8]) -> Result<bool> {
        Ok(false)
    }

    /// Whether going back means to start over, as in a compressed file, or is impossible.
    fn forward_only(&self) -> bool {
        false
    }
}
