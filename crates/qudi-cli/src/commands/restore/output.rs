//! Outputs of restored frames.

use super::args::Tonemap;
use super::chi_square_map::ChiSquareMap;
use super::plan::Plan;
use super::uncertainty::UncertaintyFile;
use super::y4m;
use crate::error::Result;
use qudi_core::{Error, Frame, linear_to_srgb, srgb_to_linear};
use qudi_io::capture::Capture;
use qudi_io::restore::{FolderRun, FrameFolder, RestoreSink, Schedule};
use qudi_io::writer::ClipWriter;
use serde_json::Value;
use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;

/// An output of frames, and the tone curve with which they are written.
pub(super) struct Output {
    place: Place,
    tonemap: Tonemap,
}

/// A place for frames.
enum Place {
    /// Frames appear one by one; an interrupted run goes on.
    Folder(FrameFolder),
    /// One file, whole or not at all.
    File(Option<ClipWriter>),
    /// Y4M on standard output.
    Pipe,
}

impl Output {
    pub(super) fn open(plan: &Plan, capture: &Capture, run: FolderRun) -> Result<Self> {
        let (path, size) = (Path::new(&plan.output), capture.size());
        let (fps, overwrite) = (plan.played_fps, plan.overwrite);
        let place = if plan.output == "-" {
            y4m::write_header(size, fps)?;
            Place::Pipe
        } else if path.extension().is_none() {
            Place::Folder(FrameFolder::open(path, size, run, overwrite)?)
        } else {
            Place::File(Some(ClipWriter::create(path, size, plan.tiff, fps, overwrite)?))
        };
        Ok(Self { place, tonemap: plan.tonemap })
    }

    /// Returns how many frames from the start of `range` on an earlier run finished.
    pub(super) fn finished(&self, range: Range<u64>) -> u64 {
        match &self.place {
            Place::Folder(folder) => folder.finished(range),
            _ => 0,
        }
    }

    /// Measures pictures that an earlier run finished.
    pub(super) fn measure_finished(
        &self,
        map: &mut ChiSquareMap,
        capture: &mut Capture,
        schedule: &Schedule,
        pictures: Range<u64>,
    ) -> Result<()> {
        let Place::Folder(folder) = &self.place else { return Ok(()) };
        let mut counts = vec![0; capture.size().pixels()];
        for picture in pictures {
            schedule.instants.read(capture, picture, &mut counts)?;
            map.add(&self.linear(folder.read(picture)?), &counts)?;
        }
        Ok(())
    }

    /// Gives a file its name, or notes in the folder's manifest that it is complete.
    pub(super) fn finish(&mut self, results: &Value, complete: bool) -> Result<()> {
        match &mut self.place {
            Place::Folder(folder) if complete => Ok(folder.finish(results)?),
            Place::Folder(_) | Place::Pipe => Ok(()),
            Place::File(writer) => Ok(writer.take().map_or(Ok(()), ClipWriter::finish)?),
        }
    }

    /// Inverts the tone curve.
    fn linear(&self, mut frame: Frame) -> Frame {
        if self.tonemap == Tonemap::Srgb {
            for value in &mut frame.data {
                *value = srgb_to_linear(*value);
            }
        }
        frame
    }

    /// Writes picture `number`, and returns it as a reader of the file sees it, where that differs.
    fn push(&mut self, number: u64, restored: &Frame) -> qudi_core::Result<Option<Frame>> {
        let frame = toned(self.tonemap, restored);
        match &mut self.place {
            Place::Folder(folder) => {
                let seen = folder.push(number, &frame)?;
                return Ok(Some(self.linear(seen)));
            }
            Place::File(writer) => writer.as_mut().map_or(Ok(()), |writer| writer.push(&frame))?,
            Place::Pipe => y4m::write_frame(&frame)
                .map_err(|e| Error::io("write to", Path::new("standard output"), e))?,
        }
        Ok(None)
    }
}

/// Applies a tone curve to a frame.
pub(super) fn toned(tonemap: Tonemap, frame: &Frame) -> Cow<'_, Frame> {
    if tonemap == Tonemap::None {
        return Cow::Borrowed(frame);
    }
    let data = frame.data.iter().map(|value| linear_to_srgb(value.max(0.0))).collect();
    Cow::Owned(Frame { size: frame.size, data })
}

/// A sink of restored frames: it writes them and measures their chi-square.
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
        // The picture is measured as a reader of the file sees it.
        let seen = self.output.push(number, restored)?;
        match &mut self.map {
            Some(map) => map.add(seen.as_ref().unwrap_or(restored), counts),
            None => Ok(()),
        }
    }
}
