//! Where restored frames go.

use super::chi_square_map::ChiSquareMap;
use super::uncertainty::UncertaintyFile;
use super::y4m;
use crate::error::Result;
use qudi_core::atomic_file::Overwrite;
use qudi_core::{Error, Frame};
use qudi_io::capture::Capture;
use qudi_io::restore::{FolderRun, FrameFolder, RestoreSink};
use qudi_io::writer::{ClipWriter, TiffSamples};
use serde_json::Value;
use std::ops::Range;
use std::path::Path;

/// One place for frames.
pub(super) enum Output {
    /// Frames appear one by one; an interrupted run goes on.
    Folder(FrameFolder),
    /// One file, whole or not at all.
    File(Option<ClipWriter>),
    /// Y4M on standard output.
    Pipe,
}

impl Output {
    pub(super) fn open(
        name: &str,
        capture: &Capture,
        run: FolderRun,
        tiff: TiffSamples,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let (path, size) = (Path::new(name), capture.size());
        if name == "-" {
            y4m::write_header(size, capture.fps())?;
            return Ok(Self::Pipe);
        }
        if path.extension().is_none() {
            return Ok(Self::Folder(FrameFolder::open(path, size, run, overwrite)?));
        }
        Ok(Self::File(Some(ClipWriter::create(path, size, tiff, overwrite)?)))
    }

    /// Frames from the start of `range` on that an earlier run finished.
    pub(super) fn finished(&self, range: Range<u64>) -> u64 {
        match self {
            Self::Folder(folder) => folder.finished(range),
            _ => 0,
        }
    }

    /// Measures frames that an earlier run finished.
    pub(super) fn measure_finished(
        &self,
        map: &mut ChiSquareMap,
        capture: &mut Capture,
        frames: Range<u64>,
    ) -> Result<()> {
        let Self::Folder(folder) = self else { return Ok(()) };
        let mut counts = vec![0; capture.size().pixels()];
        for frame in frames {
            capture.read(frame, &mut counts)?;
            map.add(&folder.read(frame)?, &counts)?;
        }
        Ok(())
    }

    /// Gives a file its name, or notes in the folder's manifest that it is complete.
    pub(super) fn finish(&mut self, results: &Value, complete: bool) -> Result<()> {
        match self {
            Self::Folder(folder) if complete => Ok(folder.finish(results)?),
            Self::Folder(_) | Self::Pipe => Ok(()),
            Self::File(writer) => Ok(writer.take().map_or(Ok(()), ClipWriter::finish)?),
        }
    }
}

/// Takes restored frames: writes them, and measures how well they explain the photons.
pub(super) struct Sink<'a> {
    output: &'a mut Output,
    map: Option<&'a mut ChiSquareMap>,
    uncertainty: &'a mut UncertaintyFile,
}

impl<'a> Sink<'a> {
    pub(super) fn new(
        output: &'a mut Output,
        map: Option<&'a mut ChiSquareMap>,
        uncertainty: &'a mut UncertaintyFile,
    ) -> Self {
        Self { output, map, uncertainty }
    }
}

impl RestoreSink for Sink<'_> {
    fn uncertainty(&mut self, _: u64, sigma: &Frame) -> qudi_core::Result<()> {
        self.uncertainty.push(sigma)
    }

    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        // What a reader of the file will see is what is measured.
        let seen = match &mut *self.output {
            Output::Folder(folder) => Some(folder.push(number, restored)?),
            Output::File(writer) => {
                writer.as_mut().map_or(Ok(()), |writer| writer.push(restored))?;
                None
            }
            Output::Pipe => {
                y4m::write_frame(restored)
                    .map_err(|e| Error::io("write to", Path::new("standard output"), e))?;
                None
            }
        };
        match &mut self.map {
            Some(map) => map.add(seen.as_ref().unwrap_or(restored), counts),
            None => Ok(()),
        }
    }
}
