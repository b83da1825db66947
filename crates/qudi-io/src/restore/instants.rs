//! Which instants of a capture become pictures.

use crate::capture::Capture;
use qudi_core::windows::Windows;
use qudi_core::{Error, Result};
use serde::Serialize;

/// Sums between pictures from which on a window of its own costs no more than windows that follow each other.
const APART: u64 = 8;

/// The pictures that are made of a capture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Instants {
    /// One for every so many output frames, from the first on.
    Frames {
        /// Output frames from one picture to the next.
        step: u64,
    },
    /// One for every so many native frames, each in the middle of a window of its own: sums may overlap those
    /// of other pictures.
    Centred {
        /// Native frames from one picture to the next.
        every: u64,
    },
}

/// In which windows which pictures are made.
#[derive(Clone, Copy, Debug)]
pub struct Schedule {
    /// Windows that follow each other.
    pub windows: Windows,
    /// The pictures.
    pub instants: Instants,
}

impl Schedule {
    /// A picture of every output frame.
    pub fn all(windows: Windows) -> Self {
        Self { windows, instants: Instants::Frames { step: 1 } }
    }
}

impl Instants {
    /// A picture for every `every` native frames of `capture`.
    ///
    /// # Errors
    /// [`Error::Request`] if a pipe is asked for windows that overlap, or for more than its frames.
    pub fn every(every: u64, capture: &Capture) -> Result<Self> {
        let sum = u64::from(capture.summed());
        let on_grid = every.is_multiple_of(sum);
        if on_grid && (every / sum < APART || capture.length().is_none()) {
            return Ok(Self::Frames { step: every / sum });
        }
        let fault = |what: String, help: String| Err(Error::request(what, "every", help));
        match capture.length() {
            None => fault(
                format!("a picture for every {every} frames of a pipe whose sums are {sum} frames"),
                format!("use a multiple of {sum}, or store the capture in a file"),
            ),
            Some(_) if every > capture.native_frames() => fault(
                format!("a picture for every {every} frames of {}", capture.native_frames()),
                "ask for one for every so many frames of the capture".to_owned(),
            ),
            Some(_) if capture.forward_only() => fault(
                "a picture for every so many frames of a compressed file".to_owned(),
                format!("use a multiple of {sum} below {}, or unpack the file", APART * sum),
            ),
            Some(_) => Ok(Self::Centred { every }),
        }
    }

    /// The native frame that the sum of `sum` frames of a picture begins with.
    pub fn begins_at(self, picture: u64, sum: u64) -> u64 {
        match self {
            Self::Frames { step } => picture * step * sum,
            Self::Centred { every } => picture * every,
        }
    }

    /// Pictures of `frames` output frames, or of a capture of `native` frames summed by `sum`.
    pub fn pictures(self, capture: &Capture) -> Option<u64> {
        match self {
            Self::Frames { step } => capture.length().map(|frames| frames.div_ceil(step)),
            Self::Centred { every } => {
                let sum = u64::from(capture.summed());
                Some((capture.native_frames() - sum) / every + 1)
            }
        }
    }
}
