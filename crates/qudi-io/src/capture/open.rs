//! Opening captures: from a path, a pipe, or an array that a caller holds.

use super::Capture;
use super::view::View;
use crate::codec::{self, GivenArray};
use crate::description::{CaptureInfo, ReadOptions, keep_pedestal, with_pedestal};
use crate::frames::CountFrames;
use crate::frames::memory::MemoryFrames;
use crate::frames::pipe::STDIN;
use qudi_core::sensor::{Response, Sensor};
use qudi_core::{Error, Result, Size};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Opens the container at `path`. Where its record or the sensor names a filter and the container is gray,
/// the channel of `options` is a letter of the filter's pattern, which a container knows nothing of.
fn container(
    path: &Path,
    options: &ReadOptions,
    sensor: Option<&Sensor>,
) -> Result<(Box<dyn CountFrames>, CaptureInfo)> {
    if options.channel.is_some() && options.cfa.is_none() {
        let gray = ReadOptions { channel: None, ..options.clone() };
        if let Ok((frames, info)) = codec::open(path, &gray) {
            let of_sensor = |sensor: &Sensor| sensor.colour.as_ref()?.cfa.as_ref().map(|_| ());
            let named =
                info.cfa.is_some() || sensor.or(info.sensor.as_ref()).and_then(of_sensor).is_some();
            if named && !info.full_colour {
                return Ok((frames, info));
            }
        }
    }
    codec::open(path, options)
}

impl Capture {
    /// Opens the capture at `path`. Its dark map and bad pixels come from `sensor`, if `options` name none.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, is of no known format, or an option does not fit.
    pub fn open(path: &Path, options: &ReadOptions, sensor: Option<&Sensor>) -> Result<Self> {
        let mut options = with_pedestal(options, sensor);
        let named = options.offset.is_some() || options.threshold.is_some();
        let kept = keep_pedestal(&mut options, sensor);
        let (native, mut info) = container(path, &options, sensor)?;
        info.pedestal = kept;
        // A record next to the file may name a sensor with a pedestal, above which its counts were taken.
        let recorded = info.sensor.as_ref().map_or(0.0, |sensor| sensor.offset);
        if recorded > 0.0 && !named {
            options.offset = Some(recorded);
            let kept = keep_pedestal(&mut options, info.sensor.as_ref());
            let (native, mut info) = container(path, &options, sensor)?;
            info.pedestal = kept;
            return Self::assemble(path, native, info, &options, sensor);
        }
        Self::assemble(path, native, info, &options, sensor)
    }

    /// Opens a capture from `reader`: a `.npy`, or raw frames that `options` describe. Each frame arrives
    /// once: [`Capture::wait_for`] waits for more, and statistics see the first window.
    ///
    /// # Errors
    /// As [`Capture::open`].
    pub fn from_pipe(
        reader: impl Read + Send + 'static,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<Self> {
        let mut options = with_pedestal(options, sensor);
        let kept = keep_pedestal(&mut options, sensor);
        let (native, mut info) = codec::open_pipe(Box::new(reader), &options)?;
        info.pedestal = kept;
        Self::assemble(Path::new(STDIN), native, info, &options, sensor)
    }

    /// Opens frames that a caller holds. They are read as the same array in a `.npy` file is.
    ///
    /// # Errors
    /// As [`Capture::open`].
    pub fn from_array(
        array: GivenArray,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<Self> {
        let mut options = with_pedestal(options, sensor);
        let kept = keep_pedestal(&mut options, sensor);
        let path = PathBuf::from(&array.name);
        let (native, mut info) = array.open(&options)?;
        info.pedestal = kept;
        Self::assemble(&path, native, info, &options, sensor)
    }

    /// Creates a capture from output frames of `sensor` in memory, `[frames][height * width]`.
    ///
    /// # Errors
    /// [`Error::Request`] if there are none, or one has another size.
    pub fn in_memory(
        name: &str,
        size: Size,
        frames: Vec<Vec<u16>>,
        sensor: &Sensor,
    ) -> Result<Self> {
        let place = Path::new(name);
        if frames.is_empty() || frames.iter().any(|frame| frame.len() != size.pixels()) {
            return Err(Error::request(
                format!("{} frames, not all of {size}", frames.len()),
                place.display(),
                "give at least one frame, all of one size",
            ));
        }
        let mut info = CaptureInfo::new("memory", "counts in memory");
        info.max_count = Some(sensor.max_count());
        info.binary = sensor.response == Response::Binary;
        info.sensor = Some(sensor.clone());
        let view = View { size, from: None };
        let range = 0..frames.len() as u64;
        let native = Box::new(MemoryFrames { size, frames });
        let capture = Self::unjudged(place, native, info, [view.clone(), view], range);
        Ok(Self { complete: true, ..capture })
    }
}
