//! Frames with one sample per pixel.

use super::count_frames::CountFrames;
use super::frame_bytes::FrameBytes;
use crate::description::{CaptureInfo, ReadOptions};
use crate::frames::levels::infer_levels;
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};

/// The scale of stored values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scale {
    /// Values are counts.
    Counts,
    /// Values are means of `levels` binary frames, where `full` stands for all ones.
    Means { levels: u16, full: f32 },
    /// Values are counts above a pedestal of `offset` DN; with a threshold, values above it count 1.
    Pedestal { offset: f32, threshold: Option<f32> },
}

impl Scale {
    /// Returns the scale that the options `levels`, `offset` and `threshold` set; `full` is the value that
    /// stands for all ones.
    pub(crate) fn asked(options: &ReadOptions, full: f32, info: &mut CaptureInfo) -> Option<Self> {
        if options.offset.is_some() || options.threshold.is_some() {
            let offset = options.offset.unwrap_or(0.0) as f32;
            let threshold = options.threshold.map(|threshold| threshold as f32);
            if threshold.is_some() {
                info.max_count = Some(1);
                info.binary = true;
            }
            return Some(Self::Pedestal { offset, threshold });
        }
        let levels = options.levels?;
        info.max_count = Some(levels);
        info.binary = true;
        Some(Self::Means { levels, full })
    }

    /// Infers the scale from some values, in any order.
    pub(crate) fn seen(
        values: impl IntoIterator<Item = u16>,
        full: u16,
        info: &mut CaptureInfo,
    ) -> Self {
        let mut is_seen = vec![false; 1 << 16];
        for value in values {
            is_seen[usize::from(value)] = true;
        }
        let values: Vec<u16> =
            (0..=u16::MAX).filter(|&value| is_seen[usize::from(value)]).collect();
        let Some(levels) = infer_levels(&values, full) else { return Self::Counts };
        info.max_count = Some(levels);
        info.notes.push(format!(
            "values are multiples of {full}/{levels}: read as counts up to {levels}; `levels` says otherwise"
        ));
        Self::Means { levels, full: f32::from(full) }
    }

    /// Returns the count of a stored value; `None` if it stands for no count.
    pub(crate) fn count(self, value: f32) -> Option<u16> {
        let count = match self {
            Self::Counts => value,
            Self::Pedestal { offset, threshold: None } => (value - offset).round().max(0.0),
            Self::Pedestal { offset, threshold: Some(threshold) } => {
                f32::from(u8::from(value - offset > threshold))
            }
            Self::Means { levels, full } => {
                let exact = value * f32::from(levels) / full;
                let count = exact.round_ties_even();
                // Integer files round the mean, or truncate it.
                let slack = if full > 1.0 { f32::from(levels) / full } else { 0.0 };
                if (exact - count).abs() > slack + 1e-3 {
                    return None;
                }
                count
            }
        };
        let whole = count as u16;
        (f32::from(whole) == count).then_some(whole)
    }
}

/// Colour channels of each pixel, and the one that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Channel {
    pub(crate) of: usize,
    pub(crate) index: usize,
}

pub(crate) const MONO: Channel = Channel { of: 1, index: 0 };

pub(crate) struct SampleFrames {
    bytes: FrameBytes,
    sample: Sample,
    size: Size,
    transposed: bool,
    channel: Channel,
    scale: Scale,
    path: PathBuf,
    /// Pixels that may hold anything; empty for none.
    ignored: Vec<bool>,
    buffer: Vec<u8>,
}

impl SampleFrames {
    /// Creates frames from `[height][width][channels]` samples, or `[width][height]` ones if `transposed`.
    pub(crate) fn new(
        bytes: FrameBytes,
        sample: Sample,
        size: Size,
        transposed: bool,
        channel: Channel,
        scale: Scale,
        path: &Path,
    ) -> Self {
        debug_assert_eq!(bytes.frame_bytes(), size.pixels() * channel.of * sample.bytes());
        let path = path.to_owned();
        let (ignored, buffer) = (Vec::new(), Vec::new());
        Self { bytes, sample, size, transposed, channel, scale, path, ignored, buffer }
    }
}

impl CountFrames for SampleFrames {
    fn frames(&self) -> u64 {
        self.bytes.frames()
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        self.buffer.resize(self.bytes.frame_bytes(), 0);
        self.bytes.read(frame, &mut self.buffer)?;
        let bytes = self.sample.bytes();
        let pixel = bytes * self.channel.of;
        let stored =
            self.buffer.chunks_exact(pixel).map(|p| &p[self.channel.index * bytes..][..bytes]);
        let Size { height, width } = self.size;
        let place = |i: usize| if self.transposed { i % height * width + i / height } else { i };
        if self.scale == Scale::Counts && matches!(self.sample, Sample::U8 | Sample::Bool) {
            for (i, value) in stored.enumerate() {
                counts[place(i)] =
                    u16::from(if self.sample == Sample::Bool { value[0].min(1) } else { value[0] });
            }
            return Ok(());
        }
        if let (Scale::Counts, Sample::U16 { big_endian }) = (self.scale, self.sample) {
            let read = if big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
            for (i, value) in stored.enumerate() {
                counts[place(i)] = read([value[0], value[1]]);
            }
            return Ok(());
        }
        for (i, value) in stored.enumerate() {
            let value = self.sample.decode(value);
            counts[place(i)] = match self.scale.count(value) {
                Some(count) => count,
                None if self.ignored.get(place(i)) == Some(&true) => 0,
                None => return Err(no_count(value, frame, &self.path)),
            };
        }
        Ok(())
    }

    fn ignore(&mut self, pixels: &[bool]) {
        self.ignored = pixels.to_vec();
    }

    fn verify(&mut self) -> Result<()> {
        self.bytes.verify()
    }

    fn forward_only(&self) -> bool {
        self.bytes.forward_only()
    }

    fn length(&self) -> Option<u64> {
        self.bytes.length()
    }

    fn wait_for(&mut self, frames: u64, notes: &mut Vec<String>) -> Result<u64> {
        self.bytes.wait_for(frames, notes)
    }

    fn discard_before(&mut self, frame: u64) {
        self.bytes.discard_before(frame);
    }
}

/// Returns the error of a value that no photon counter gives.
pub(crate) fn no_count(value: f32, frame: u64, path: &Path) -> Error {
    Error::data(
        format!("frame {frame} holds {value}, and photon counts are whole numbers from 0 to 65535"),
        path,
        "means of N binary frames are read with `levels N`, counts above a pedestal with `offset DN`; an image without photon counts is not a capture",
    )
}
