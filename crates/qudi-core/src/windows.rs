//! Division of a long capture into overlapping windows, and blending of their results into one clip.

use crate::error::{Error, Result};
use crate::frame::Frame;
use crate::restorer::Restorer;
use std::collections::VecDeque;
use std::ops::Range;

/// Largest number of frames on either side: a window of 11.
pub const LONGEST_HALF: usize = 5;

/// Windows of equal length over a number of frames; the last one is moved to end with the capture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Windows {
    frames: u64,
    length: u64,
    stride: u64,
    /// Frames at the beginning and at the end of a window that its neighbours restore.
    context: [u64; 2],
}

impl Windows {
    /// Creates windows of `length` frames, each sharing `overlap` with the one before.
    ///
    /// # Errors
    /// [`Error::Request`] if the overlap is no shorter than the window.
    pub fn new(frames: u64, length: u64, overlap: u64) -> Result<Self> {
        if length == 0 || overlap >= length {
            return Err(Error::request(
                format!("windows of {length} frames that share {overlap}"),
                "window, overlap",
                "windows are longer than their overlap",
            ));
        }
        Ok(Self { frames, length, stride: length - overlap, context: [0, 0] })
    }

    /// Creates the windows in which `restorer` restores a capture of `frames` frames. Each shares `overlap`
    /// of its restored frames with the one before.
    ///
    /// # Errors
    /// [`Error::Request`] if the overlap is no shorter than what a window restores.
    pub fn of(restorer: &dyn Restorer, frames: u64, overlap: u64) -> Result<Self> {
        let context = restorer.context().map(|frames| frames as u64);
        let length = restorer.window() as u64;
        let restored = length.saturating_sub(context[0] + context[1]);
        let Self { stride, .. } = Self::new(frames, restored, overlap)?;
        Ok(Self { frames, length, stride, context })
    }

    /// Returns the same windows over another number of frames.
    #[must_use]
    pub fn over(self, frames: u64) -> Self {
        Self { frames, ..self }
    }

    /// Returns the number of windows.
    pub fn count(&self) -> u64 {
        (self.frames - self.held()).div_ceil(self.stride) + 1
    }

    /// Returns the frames of window `number`.
    pub fn range(&self, number: u64) -> Range<u64> {
        let start = (number * self.stride).min(self.frames - self.held());
        start..start + self.held()
    }

    /// Returns the frames that window `number` restores: all but its context, which its neighbours restore.
    pub fn restored(&self, number: u64) -> Range<u64> {
        let Range { start, end } = self.range(number);
        let first = if number == 0 { start } else { start + self.context[0] };
        let last = number + 1 >= self.count();
        first..if last { end } else { end - self.context[1] }
    }

    /// Returns the end (exclusive) of window `number`, had the capture that many frames.
    pub fn nominal_end(&self, number: u64) -> u64 {
        number.saturating_mul(self.stride).saturating_add(self.length)
    }

    /// Returns the number of frames of every window.
    fn held(&self) -> u64 {
        self.length.min(self.frames)
    }

    /// Returns the weight of window `number` at `frame`, which the window before restores, too: over an
    /// overlap of `n` frames it grows linearly from `1 / (n + 1)` to `n / (n + 1)`.
    pub fn weight(&self, number: u64, frame: u64) -> f32 {
        let range = self.restored(number);
        let before = self.restored(number.saturating_sub(1));
        let shared = before.end.saturating_sub(range.start);
        (frame - range.start + 1) as f32 / (shared + 1) as f32
    }

    /// Returns the number of the first window that restores `frame`.
    pub fn first_with(&self, frame: u64) -> u64 {
        (0..self.count()).find(|&n| self.restored(n).end > frame).unwrap_or(0)
    }
}

/// Blending of the frames of overlapping windows.
#[derive(Debug, Default)]
pub struct CrossFade {
    /// Number of the first waiting frame.
    first: u64,
    waiting: VecDeque<Frame>,
}

impl CrossFade {
    /// Adds the frames of a window, from number `start` on. `weight` is the share of a frame in the blend
    /// with the same frame of the window before.
    pub fn push(&mut self, start: u64, frames: Vec<Frame>, weight: impl Fn(u64) -> f32) {
        if self.waiting.is_empty() {
            self.first = start;
        }
        let shared = (self.first + self.waiting.len() as u64 - start) as usize;
        let from = self.waiting.len() - shared;
        let mut frames = frames.into_iter();
        for (number, (old, new)) in
            (start..).zip(self.waiting.iter_mut().skip(from).zip(&mut frames))
        {
            let weight = weight(number);
            for (old, new) in old.data.iter_mut().zip(new.data) {
                *old += weight * (new - *old);
            }
        }
        self.waiting.extend(frames);
    }

    /// Returns the next finished frame with its number, if it comes before `until`, where the next window
    /// begins.
    pub fn pop(&mut self, until: u64) -> Option<(u64, Frame)> {
        if self.first >= until {
            return None;
        }
        let frame = self.waiting.pop_front()?;
        self.first += 1;
        Some((self.first - 1, frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;
    use crate::restorer::{Acquisition, BurstView, Restored};

    #[test]
    fn windows_cover_every_frame_and_end_with_the_capture() {
        for frames in 1..60 {
            let windows = Windows::new(frames, 11, 3).unwrap();
            let mut next = 0;
            for n in 0..windows.count() {
                let range = windows.range(n);
                assert!(range.start <= next && range.end > next || n == 0, "{frames}: {range:?}");
                assert_eq!(range.end - range.start, frames.min(11));
                next = range.end;
            }
            assert_eq!(next, frames);
            for frame in 0..frames {
                let first = windows.first_with(frame);
                assert!(windows.range(first).contains(&frame));
                assert!(first == 0 || !windows.range(first - 1).contains(&frame));
            }
        }
        assert!(Windows::new(20, 3, 3).is_err());
    }

    /// Restorer that returns its input and needs some frames of context.
    struct Sees([usize; 2]);

    impl Restorer for Sees {
        fn name(&self) -> &'static str {
            "sees"
        }

        fn window(&self) -> usize {
            11 + self.0[0] + self.0[1]
        }

        fn context(&self) -> [usize; 2] {
            self.0
        }

        fn restore_frames(
            &mut self,
            burst: BurstView<'_>,
            _: &Acquisition,
            numbers: &[usize],
        ) -> Result<Restored> {
            let frames = vec![Frame::filled(burst.size, 0.0); numbers.len()];
            Ok(Restored::gray(frames, None))
        }
    }

    #[test]
    fn every_frame_is_restored_where_its_context_is_seen() {
        for [before, after] in [[0, 0], [5, 5], [10, 0], [1, 7]] {
            for frames in 1..90 {
                let windows = Windows::of(&Sees([before, after]), frames, 3).unwrap();
                let mut next = 0;
                for n in 0..windows.count() {
                    let (seen, restored) = (windows.range(n), windows.restored(n));
                    assert!(
                        restored.start <= next && restored.end > next,
                        "{frames}: {restored:?}"
                    );
                    assert!(n == 0 || next >= restored.start + 3, "{frames}: {restored:?}");
                    let first = restored.start.saturating_sub(before as u64);
                    let last = (restored.end + after as u64).min(frames);
                    assert!(
                        seen.start <= first && seen.end >= last,
                        "{frames}: {restored:?} {seen:?}"
                    );
                    next = restored.end;
                }
                assert_eq!(next, frames);
            }
        }
        assert!(Windows::of(&Sees([5, 5]), 40, 11).is_err());
    }

    /// Windows whose pixels hold a value of their own: overlaps rise evenly from one to the next.
    #[test]
    fn overlaps_fade_evenly_and_frames_come_in_order() {
        let size = Size { height: 1, width: 2 };
        let windows = Windows::new(19, 11, 3).unwrap();
        assert_eq!((windows.count(), windows.range(1)), (2, 8..19));
        let (mut fade, mut out) = (CrossFade::default(), Vec::new());
        for n in 0..2 {
            let range = windows.range(n);
            let weight = |frame| windows.weight(n, frame);
            fade.push(range.start, vec![Frame::filled(size, n as f32); 11], weight);
            let until = if n == 0 { 8 } else { 19 };
            out.extend(std::iter::from_fn(|| fade.pop(until)));
        }
        let numbers: Vec<u64> = out.iter().map(|(n, _)| *n).collect();
        assert_eq!(numbers, (0..19).collect::<Vec<_>>());
        let values: Vec<f32> = out.iter().map(|(_, frame)| frame.data[0]).collect();
        assert_eq!(values[7..12], [0.0, 0.25, 0.5, 0.75, 1.0]);
    }
}
