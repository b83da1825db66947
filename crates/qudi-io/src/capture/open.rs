//! Opening captures: from a path, a pipe, or an array that a caller holds.

use super::Capture;
use crate::codec::{self, GivenArray};
use crate::description::{ReadOptions, keep_pedestal, with_pedestal};
use crate::frames::pipe::STDIN;
use qudi_core::Result;
use qudi_core::sensor::Sensor;
use std::io::Read;
use std::path::{Path, PathBuf};

impl Capture {
    /// Opens the capture at `path`. Its dark map and bad pixels come from `sensor`, if `options` name none.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if it cannot be read, is of no known format, or an option does not fit.
    pub fn open(path: &Path, options: &ReadOptions, sensor: Option<&Sensor>) -> Result<Self> {
        let mut options = with_pedestal(options, sensor);
        let named = options.offset.is_some() || options.threshold.is_some();
        let kept = keep_pedestal(&mut options, sensor);
        let (native, mut info) = codec::open(path, &options)?;
        info.pedestal = kept;
        // A record next to the file may name a sensor with a pedestal, above which its counts were taken.
        let recorded = info.sensor.as_ref().map_or(0.0, |sensor| sensor.offset);
        if recorded > 0.0 && !named {
            options.offset = Some(recorded);
            let kept = keep_pedestal(&mut options, info.sensor.as_ref());
            let (native, mut info) = codec::open(path, &options)?;
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
}
