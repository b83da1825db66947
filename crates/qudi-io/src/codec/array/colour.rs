//! The axes of an array in memory: the place of the colour channels, and the one that is read.

use super::{Array, Place};
use crate::description::{Axes, ReadOptions};
use qudi_core::{Error, Result};

/// The extents of an array in the order of memory, slowest first, without colour.
pub(super) struct Layout {
    pub(super) dims: [usize; 3],
    pub(super) colours: Colours,
    /// Index of the channel that is read.
    pub(super) index: usize,
}

/// The place of the channels in memory, and their number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Colours {
    /// Channels alternate, pixel by pixel.
    Interleaved(usize),
    /// Each frame has one plane per channel.
    Planes(usize),
    /// Each channel is a whole capture.
    Volumes(usize),
}

impl Colours {
    pub(super) fn number(self) -> usize {
        match self {
            Self::Interleaved(n) | Self::Planes(n) | Self::Volumes(n) => n,
        }
    }
}

/// Largest number of channels; a longer axis is one of space or time.
const MAX_CHANNELS: usize = 4;

impl Array {
    /// Assigns the extents to axes; `axes` are the ones of memory.
    pub(super) fn layout(&self, axes: Axes, options: &ReadOptions) -> Result<Layout> {
        let mut memory = self.shape.clone();
        if self.fortran {
            memory.reverse();
        }
        let frame_axis_first = axes.frame_position() == 0;
        let (dims, colours) = match *memory.as_slice() {
            [a, b] => {
                let dims = match axes.frame_position() {
                    0 => [1, a, b],
                    1 => [a, 1, b],
                    _ => [a, b, 1],
                };
                (dims, Colours::Interleaved(1))
            }
            [a, b, c] => ([a, b, c], Colours::Interleaved(1)),
            [a, b, c, d] => {
                let few = |n: usize| (1..=MAX_CHANNELS).contains(&n);
                let last = ([a, b, c], Colours::Interleaved(d));
                let second = ([a, c, d], Colours::Planes(b));
                if self.fortran && few(a) {
                    ([b, c, d], Colours::Volumes(a))
                } else if !self.fortran && few(d) && (b != 1 || matches!(d, 3 | 4)) {
                    last
                } else if few(b) && frame_axis_first {
                    second
                } else if few(d) {
                    last
                } else {
                    return Err(self.no_capture());
                }
            }
            _ => return Err(self.no_capture()),
        };
        let index = self.channel(colours.number(), options)?;
        Ok(Layout { dims, colours, index })
    }

    pub(super) fn no_capture(&self) -> Error {
        self.fault(
            format!("an array of shape {:?} is no capture", self.shape),
            "captures have the axes frames, height, width, and perhaps colour",
        )
    }

    /// Returns the channel that is read, out of `channels`.
    fn channel(&self, channels: usize, options: &ReadOptions) -> Result<usize> {
        match (channels, options.channel_of(channels)) {
            (1, None | Some(0)) => Ok(0),
            (1, Some(index)) => Err(Error::request(
                format!("channel {index} of a gray capture, shape {:?}", self.shape),
                "channel",
                "leave it out: there is no colour to choose from",
            )),
            (3, None) if options.cfa.is_some() => Err(Error::request(
                format!(
                    "a colour filter in front of a capture of 3 channels, shape {:?}",
                    self.shape
                ),
                "cfa",
                "leave it out: every pixel has all colours",
            )),
            (_, None) => Err(self.fault(
                format!("a colour capture of {channels} channels, shape {:?}", self.shape),
                format!("read one channel as gray with `channel 0` to {}", channels - 1),
            )),
            (_, Some(index)) if index < channels => Ok(index),
            (_, Some(index)) => Err(self.fault(
                format!("channel {index} of an array of shape {:?}", self.shape),
                format!("channels count from 0 to {}", channels - 1),
            )),
        }
    }

    /// Selects one of several captures that are stored one after the other.
    pub(super) fn choose_volume(&mut self, dims: [usize; 3], index: usize) {
        // Extents come from a header: an extent that is too large fails later, when its data are missing.
        let bytes = dims.iter().try_fold(self.sample.bytes() as u64, |bytes, &extent| {
            bytes.checked_mul(extent as u64)
        });
        let bytes = bytes.unwrap_or(u64::MAX);
        match &mut self.place {
            Place::File { start, available, .. } | Place::Spool { start, available, .. } => {
                let before = bytes.saturating_mul(index as u64);
                *start = start.saturating_add(before);
                *available = available.saturating_sub(before).min(bytes);
            }
            Place::Stream(_) | Place::Fetch { .. } | Place::Pipe(_) => {}
        }
    }
}
