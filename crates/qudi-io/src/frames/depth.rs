//! Frames whose counts are checked against the known depth.

use super::count_frames::CountFrames;
use qudi_core::{Error, Result, Size};
use std::path::{Path, PathBuf};

/// Frames in which no count may exceed `max_count`.
pub(crate) struct DepthChecked {
    inner: Box<dyn CountFrames>,
    max_count: u16,
    /// Source of the depth, as in "`bits`" or "the file itself".
    source: &'static str,
    path: PathBuf,
    /// Pixels that may hold anything; empty for none.
    ignored: Vec<bool>,
}

impl DepthChecked {
    pub(crate) fn new(
        inner: Box<dyn CountFrames>,
        max_count: u16,
        source: &'static str,
        path: &Path,
    ) -> Self {
        Self { inner, max_count, source, path: path.to_owned(), ignored: Vec::new() }
    }
}

impl CountFrames for DepthChecked {
    fn frames(&self) -> u64 {
        self.inner.frames()
    }

    fn size(&self) -> Size {
        self.inner.size()
    }

    // Sums are made of frames that are read one by one, so that each is checked.
    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        self.inner.read(frame, counts)?;
        for (count, _) in counts.iter_mut().zip(&self.ignored).filter(|(_, ignored)| **ignored) {
            *count = (*count).min(self.max_count);
        }
        let Some(&largest) = counts.iter().max().filter(|&&largest| largest > self.max_count)
        else {
            return Ok(());
        };
        let (max, bits) = (self.max_count, 16 - self.max_count.leading_zeros());
        Err(Error::data(
            format!(
                "frame {frame} holds a count of {largest}, beyond the {max} ({bits} bit) that {} allows",
                self.source
            ),
            &self.path,
            "check `format`, `bits` and `levels`, and that a record beside the file belongs to it",
        ))
    }

    fn length(&self) -> Option<u64> {
        self.inner.length()
    }

    fn wait_for(&mut self, frames: u64, notes: &mut Vec<String>) -> Result<u64> {
        self.inner.wait_for(frames, notes)
    }

    fn discard_before(&mut self, frame: u64) {
        self.inner.discard_before(frame);
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.ignored = pixels.to_vec();
        self.inner.ignore(pixels);
    }

    fn verify(&mut self) -> Result<()> {
        self.inner.verify()
    }

    fn forward_only(&self) -> bool {
        self.inner.forward_only()
    }
}
