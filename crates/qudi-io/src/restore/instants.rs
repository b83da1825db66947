//! The instants of a capture that become pictures.

use crate::capture::Capture;
use qudi_core::windows::Windows;
use qudi_core::{Error, Result};
use std::ops::Range;

/// Sums between pictures from which on separate windows cost no more than consecutive ones.
const MIN_SEPARATE_SUMS: u64 = 8;

/// The pictures that are made of a capture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Instants {
    /// The output frame nearest before every `every` native frames.
    Frames {
        /// Native frames from one picture to the next, no fewer than are summed.
        every: u64,
        /// Native frames of an output frame.
        sum: u64,
    },
    /// One picture for every `every` native frames, each in the middle of a window of its own: sums may
    /// overlap with the sums of other pictures.
    Centred {
        /// Native frames from one picture to the next.
        every: u64,
    },
}

/// The windows and the pictures that are made in them.
#[derive(Clone, Copy, Debug)]
pub struct Schedule {
    /// Consecutive windows.
    pub windows: Windows,
    /// The pictures.
    pub instants: Instants,
}

impl Schedule {
    /// Makes a picture of every output frame.
    pub fn all(windows: Windows) -> Self {
        Self { windows, instants: Instants::Frames { every: 1, sum: 1 } }
    }
}

impl Instants {
    /// Makes a picture for every `every` native frames of `capture`.
    ///
    /// # Errors
    /// [`Error::Request`] if a pipe is asked for windows that overlap, or for more than its frames.
    pub fn every(every: u64, capture: &Capture) -> Result<Self> {
        let sum = u64::from(capture.summed());
        let close = every >= sum && every / sum < MIN_SEPARATE_SUMS;
        if close || every >= sum && capture.length().is_none() {
            return Ok(Self::Frames { every, sum });
        }
        let fault = |what: String, help: String| Err(Error::request(what, "every", help));
        match capture.length() {
            None => fault(
                format!("a picture for every {every} frames of a pipe whose sums are {sum} frames"),
                format!("use at least {sum}, or store the capture in a file"),
            ),
            Some(_) if every > capture.native_frames() => fault(
                format!("a picture for every {every} frames of {}", capture.native_frames()),
                "ask for one for every so many frames of the capture".to_owned(),
            ),
            Some(_) if capture.forward_only() => fault(
                "a picture for every so many frames of a compressed file".to_owned(),
                format!("use {sum} to {}, or unpack the file", MIN_SEPARATE_SUMS * sum - 1),
            ),
            Some(_) => Ok(Self::Centred { every }),
        }
    }

    /// Returns the output frame of a picture, where pictures are output frames.
    pub(super) fn frame_of(self, picture: u64) -> u64 {
        match self {
            Self::Frames { every, sum } => picture.saturating_mul(every) / sum,
            Self::Centred { .. } => picture,
        }
    }

    /// Returns the number of pictures before output frame `frame`, where pictures are output frames.
    pub(super) fn pictures_before(self, frame: u64) -> u64 {
        match self {
            Self::Frames { every, sum } => frame.saturating_mul(sum).div_ceil(every),
            Self::Centred { .. } => frame,
        }
    }

    /// Returns the native frame with which the sum of `sum` frames of a picture begins.
    fn begins_at(self, picture: u64, sum: u64) -> u64 {
        match self {
            Self::Frames { .. } => self.frame_of(picture) * sum,
            Self::Centred { every } => picture * every,
        }
    }

    /// Returns the number of pictures of `capture`; `None` while the length of a pipe is unknown.
    pub fn pictures(self, capture: &Capture) -> Option<u64> {
        let parts = self.parts(capture);
        match self {
            Self::Frames { .. } if parts.len() == 1 => {
                capture.length().map(|frames| self.pictures_before(frames))
            }
            _ => parts.last().map(|(_, pictures)| pictures.end),
        }
    }

    /// Returns the parts of `capture`, and the pictures of each.
    pub(super) fn parts(self, capture: &Capture) -> Vec<(Range<u64>, Range<u64>)> {
        let sum = u64::from(capture.summed());
        let mut end = 0;
        let parts = capture.parts().into_iter().map(|part| {
            let frames = part.end - part.start;
            let pictures = match self {
                Self::Frames { .. } => self.pictures_before(frames / sum),
                Self::Centred { every } => (frames + every).saturating_sub(sum) / every,
            };
            end += pictures;
            (part, end - pictures..end)
        });
        parts.collect()
    }

    /// Reads the counts of a picture, as the run that made it did.
    ///
    /// # Errors
    /// [`Error`] if the capture cannot be read.
    pub fn read(self, capture: &mut Capture, picture: u64, counts: &mut [u16]) -> Result<()> {
        let sum = u64::from(capture.summed());
        let parts = self.parts(capture);
        let Some((part, pictures)) = parts.iter().find(|(_, all)| all.contains(&picture)) else {
            return Err(Error::request(
                format!("picture {picture}"),
                capture.path().display(),
                "ask for pictures of the capture",
            ));
        };
        let first = self.begins_at(picture - pictures.start, sum);
        capture.in_part(part, |capture| capture.read_from(first, counts))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_the_frames_nearest_before_their_instants() {
        for (every, sum) in [(1, 1), (3, 1), (7, 7), (100, 73), (20, 7), (55, 7)] {
            let instants = Instants::Frames { every, sum };
            let frames: Vec<u64> = (0..40).map(|picture| instants.frame_of(picture)).collect();
            for (picture, &frame) in (0..).zip(&frames) {
                assert_eq!(instants.pictures_before(frame), picture, "{every} of {sum}");
                let instant = picture * every;
                assert!(frame * sum <= instant && instant < (frame + 1) * sum);
            }
        }
    }
}
