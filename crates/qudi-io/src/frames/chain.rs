//! Captures in several parts, one after the other; one part is open at a time.

use super::count_frames::CountFrames;
use qudi_core::Result;
use qudi_core::Size;
use std::ops::Range;

/// A function that opens a part by number.
type OpenPart = Box<dyn Fn(usize) -> Result<Box<dyn CountFrames>> + Send>;

pub(crate) struct Chain {
    size: Size,
    /// Number of the first frame of each part, and the total.
    firsts: Vec<u64>,
    opener: OpenPart,
    open: Option<(usize, Box<dyn CountFrames>)>,
    /// Pixels that may hold anything; empty for none.
    ignored: Vec<bool>,
}

impl Chain {
    pub(crate) fn new(size: Size, lengths: &[u64], opener: OpenPart) -> Self {
        let mut firsts = vec![0];
        for length in lengths {
            firsts.push(firsts[firsts.len() - 1] + length);
        }
        Self { size, firsts, opener, open: None, ignored: Vec::new() }
    }

    /// Opens the part that holds `frame`, and returns it with the frame's number in it.
    fn part(&mut self, frame: u64) -> Result<(usize, &mut dyn CountFrames)> {
        let at = self.firsts.partition_point(|&first| first <= frame) - 1;
        if self.open.as_ref().is_none_or(|(open, _)| *open != at) {
            self.open = None;
            let mut part = (self.opener)(at)?;
            part.ignore(&self.ignored);
            self.open = Some((at, part));
        }
        Ok((at, self.open.as_mut().expect("opened above").1.as_mut()))
    }
}

impl CountFrames for Chain {
    fn frames(&self) -> u64 {
        self.firsts[self.firsts.len() - 1]
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        let (at, _) = self.part(frame)?;
        let within = frame - self.firsts[at];
        self.part(frame)?.1.read(within, counts)
    }

    fn add(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        let mut first = frames.start;
        while first < frames.end {
            let (at, _) = self.part(first)?;
            let (start, end) = (self.firsts[at], self.firsts[at + 1].min(frames.end));
            self.part(first)?.1.add(first - start..end - start, sums)?;
            first = end;
        }
        Ok(())
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.ignored = pixels.to_vec();
        self.open = None;
    }

    fn forward_only(&self) -> bool {
        self.open.as_ref().is_some_and(|(_, part)| part.forward_only())
    }
}
