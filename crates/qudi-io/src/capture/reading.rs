//! Reading frames of a capture, and sums of them.

use super::Capture;
use qudi_core::{Error, Result};
use std::ops::Range;

impl Capture {
    /// Reads output frame `frame`, bad pixels repaired.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be read, or a sum does not fit into 16 bits.
    pub fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        self.check(frame..frame + 1)?;
        self.read_from(self.begins(frame), counts)
    }

    /// Reads the output frame that begins with native frame `native`, counted from the first in use; sums may
    /// begin at any native frame. Bad pixels are repaired.
    ///
    /// # Errors
    /// As [`Capture::read`].
    pub fn read_from(&mut self, native: u64, counts: &mut [u16]) -> Result<()> {
        let frame = native / u64::from(self.sum);
        let end = native.saturating_add(self.sum.into());
        if end > self.native_frames() {
            return Err(Error::request(
                format!("frames {native} to {end} of {}", self.native_frames()),
                self.path.display(),
                "ask for frames of the capture",
            ));
        }
        if self.sum == 1 {
            let stored = self.range.start + native;
            let stored = self.stand_ins.get(&stored).copied().unwrap_or(stored);
            self.native.read(stored, &mut self.stored)?;
            if let Some(piped) = &mut self.piped {
                let note = piped.judge(stored, &mut self.stored, self.native.size());
                self.info.notes.extend(note);
            }
            self.view.apply(&self.stored, counts);
        } else {
            let mut sums = vec![0; self.size().pixels()];
            self.stored_sum(self.range.start + native..self.range.start + end, &mut sums)?;
            for (count, sum) in counts.iter_mut().zip(sums) {
                *count = u16::try_from(sum).map_err(|_| {
                    Error::request(
                        format!("frame {frame} sums to {sum}, which does not fit into 16 bits"),
                        "sum",
                        "sum fewer frames",
                    )
                })?;
            }
        }
        self.repair.frame(frame, counts);
        Ok(())
    }

    /// Copies packed frames as they are, from `first` on: rows of whole bytes, the first pixel in the highest
    /// bit. Returns false if they have to be read one by one, since they are turned, summed, repaired, or
    /// stored in another way.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be read.
    pub fn copy_packed(&mut self, first: u64, bytes: &mut [u8]) -> Result<bool> {
        let untouched = self.sum == 1
            && self.view.from.is_none()
            && self.repair.count() == 0
            && self.stand_ins.is_empty();
        if !untouched || self.info.packing.is_none() {
            return Ok(false);
        }
        let frame_bytes = self.size().height * self.size().width.div_ceil(8);
        self.check(first..first + (bytes.len() / frame_bytes) as u64)?;
        self.native.copy_packed(self.range.start + first, bytes)
    }

    /// Compares the stored data with their checksum, also where their frames were not read.
    ///
    /// # Errors
    /// [`Error`] if they differ, or the file cannot be read.
    pub fn verify(&mut self) -> Result<()> {
        self.native.verify()
    }

    /// Sums output frames, bad pixels repaired.
    ///
    /// # Errors
    /// [`Error`] if the file cannot be read.
    pub fn total(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        self.stored_total(frames, sums)?;
        self.repair.sums(sums);
        Ok(())
    }

    /// Sums output frames, turned and cropped only.
    pub(super) fn stored_total(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        self.check(frames.clone())?;
        let native = |frame: u64| self.range.start + self.begins(frame);
        if self.boundaries.is_empty() || frames.end - frames.start < 2 {
            let first = native(frames.start);
            let count = (frames.end - frames.start) * u64::from(self.sum);
            return self.stored_sum(first..first + count, sums);
        }
        let mut one = vec![0; sums.len()];
        sums.fill(0);
        for frame in frames {
            self.stored_total(frame..frame + 1, &mut one)?;
            sums.iter_mut().zip(&one).for_each(|(sum, one)| *sum += one);
        }
        Ok(())
    }

    /// Sums stored frames `range`, turned and cropped only.
    fn stored_sum(&mut self, range: Range<u64>, sums: &mut [u32]) -> Result<()> {
        self.sum_stored(range)?;
        self.view.apply(&self.stored_sums, sums);
        Ok(())
    }

    /// Sums stored frames `range` into `stored_sums`. Sums that are output frames are held.
    pub(super) fn sum_stored(&mut self, range: Range<u64>) -> Result<()> {
        self.stored_sums.clear();
        self.stored_sums.resize(self.stored.len(), 0);
        let is_output = self.sum > 1 && range.end - range.start == u64::from(self.sum);
        if is_output && self.held.copy(range.start, &mut self.stored_sums) {
            return Ok(());
        }
        let mut first = range.start;
        for (&broken, &good) in self.stand_ins.range(range.clone()) {
            self.native.add(first..broken, &mut self.stored_sums)?;
            self.native.add(good..good + 1, &mut self.stored_sums)?;
            first = broken + 1;
        }
        self.native.add(first..range.end, &mut self.stored_sums)?;
        if is_output {
            self.held.hold(range.start, &self.stored_sums);
        }
        Ok(())
    }

    fn check(&self, frames: Range<u64>) -> Result<()> {
        if frames.start <= frames.end && frames.end <= self.frames() {
            return Ok(());
        }
        Err(Error::request(
            format!("frames {} to {} of {}", frames.start, frames.end, self.frames()),
            self.path.display(),
            "ask for frames of the capture",
        ))
    }
}
