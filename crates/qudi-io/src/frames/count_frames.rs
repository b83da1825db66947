//! Frames of photon counts that can be asked for by number.

use qudi_core::Result;
use qudi_core::Size;
use std::ops::Range;

/// A stack of count images, `[frames][height][width]`.
pub trait CountFrames: Send {
    /// Returns the number of frames; for a pipe, of those that have arrived.
    fn frames(&self) -> u64;

    /// Returns the number of all frames; `None` while the length of a pipe is unknown.
    fn length(&self) -> Option<u64> {
        Some(self.frames())
    }

    /// Waits until `frames` frames have arrived or the input ends, and returns how many have arrived. Notes
    /// for the user about the end are added to the notes.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the pipe ends inside a frame.
    fn wait_for(&mut self, _frames: u64, _remarks: &mut Vec<String>) -> Result<u64> {
        Ok(self.frames())
    }

    /// Allows to drop the frames before `frame`, which are not read again.
    fn discard_before(&mut self, _frame: u64) {}

    /// Returns the size of every frame.
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

    /// Copies packed frames from `first` on into `bytes`: rows of whole bytes, 8 pixels each, the first in
    /// the highest bit. Returns false if frames are stored in another way.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be read.
    fn copy_packed(&mut self, _first: u64, _bytes: &mut [u8]) -> Result<bool> {
        Ok(false)
    }

    /// Reads values that are no counts as 0 where `pixels` is set: those pixels are repaired anyway.
    fn ignore(&mut self, _pixels: &[bool]) {}

    /// Compares all of the stored data with their checksum, if they have one that was not compared yet.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if they differ, or the file cannot be read.
    fn verify(&mut self) -> Result<()> {
        Ok(())
    }

    /// Returns true if frames cannot be read again, or only by starting over, as in a compressed file.
    fn forward_only(&self) -> bool {
        false
    }
}
