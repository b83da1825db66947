//! Outputs of restored frames.

use super::args::Tonemap;
use super::chi_square_map::ChiSquareMap;
use super::plan::Plan;
use super::uncertainty::UncertaintyFile;
use super::y4m;
use crate::colour::{Rendering, encoded, is_linear};
use crate::error::Result;
use qudi_core::{Error, Frame, linear_to_srgb, srgb_to_linear};
use qudi_io::capture::Capture;
use qudi_io::restore::{FolderRun, FrameFolder, RestoreSink, Schedule};
use qudi_io::writer::{ClipWriter, Planes};
use serde_json::Value;
use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;

/// An output of frames, and how they are written.
pub(super) struct Output {
    place: Place,
    tonemap: Tonemap,
    /// How colours are written, if there are any.
    colour: Option<ColourOutput>,
}

/// How colours are written.
struct ColourOutput {
    rendering: Rendering,
    /// True if the file holds the sensor's own colours in linear light.
    is_linear: bool,
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
    pub(super) fn open(
        plan: &Plan,
        capture: &Capture,
        rendering: Option<Rendering>,
        run: FolderRun,
    ) -> Result<Self> {
        let (path, size) = (Path::new(&plan.output), capture.size());
        let (fps, overwrite) = (plan.played_fps, plan.overwrite);
        let planes = if rendering.is_some() { Planes::Rgb } else { Planes::Gray };
        let is_linear = is_linear(path, plan.tiff) && plan.tonemap() == Tonemap::None;
        let colour = rendering.map(|rendering| ColourOutput { rendering, is_linear });
        let place = if plan.output == "-" {
            y4m::write_header(size, fps)?;
            Place::Pipe
        } else if path.extension().is_none() {
            Place::Folder(FrameFolder::open(path, size, run, overwrite)?)
        } else {
            Place::File(Some(ClipWriter::create(path, size, planes, plan.tiff, fps, overwrite)?))
        };
        Ok(Self { place, tonemap: plan.tonemap(), colour })
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
        if self.colour.is_some() {
            // Colours were balanced and cut to what screens show: their counts are not known from them.
            return Ok(());
        }
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

    /// Writes the colours of picture `number`.
    fn push_colour(&mut self, number: u64, restored: &[Frame; 3]) -> qudi_core::Result<()> {
        let Some(ColourOutput { rendering, is_linear }) = &self.colour else {
            return Err(Error::request("colours of a gray capture", "cfa", "report this as a bug"));
        };
        let shown;
        let planes = if *is_linear {
            restored
        } else {
            shown = encoded(&rendering.rendered(restored));
            &shown
        };
        match &mut self.place {
            Place::Folder(folder) => folder.push_colour(number, planes)?,
            Place::File(Some(writer)) => writer.push_colour(planes)?,
            Place::File(None) | Place::Pipe => {}
        }
        Ok(())
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
        if let Some(map) = &mut self.map {
            map.add_uncertainty(sigma);
        }
        self.uncertainty.push(sigma)
    }

    fn colour_uncertainty(&mut self, _: u64, sigma: &[Frame; 3]) -> qudi_core::Result<()> {
        self.uncertainty.push_colour(sigma)
    }

    fn colour(
        &mut self,
        number: u64,
        restored: &[Frame; 3],
        counts: &[u16],
    ) -> qudi_core::Result<()> {
        self.output.push_colour(number, restored)?;
        self.map.as_mut().map_or(Ok(()), |map| map.add_colour(restored, counts))
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
