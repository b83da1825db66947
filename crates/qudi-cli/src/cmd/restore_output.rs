//! Where restored frames go, and how well they explain the photons.

use crate::cmd::restore_deviation::Deviation;
use crate::error::{Fault, Result};
use qudi_core::atomic_file::{Overwrite, refuse_taken};
use qudi_core::metrics::Consistency;
use qudi_core::restorer::Acquisition;
use qudi_core::{Frame, SimError, Size};
use qudi_io::capture::Capture;
use qudi_io::restore::{FolderRun, FrameFolder, RestoreSink};
use qudi_io::writer::{ClipWriter, Picture, TiffSamples};
use serde_json::Value;
use std::io::Write;
use std::ops::Range;
use std::path::Path;

/// One place for frames.
pub(crate) enum Output {
    /// Frames appear one by one; an interrupted run goes on.
    Folder(FrameFolder),
    /// One file, whole or not at all.
    File(Option<ClipWriter>),
    /// Y4M on standard output.
    Pipe,
}

impl Output {
    /// Refuses a taken name before any work is done. Folders may be gone on with.
    pub(crate) fn refuse_taken(name: &str, sharded: bool, overwrite: Overwrite) -> Result<()> {
        let folder = Path::new(name).extension().is_none() && name != "-";
        if sharded && !folder {
            return Err(Fault::new(
                "parts of the work can only meet in a folder",
                "--shard",
                "give a name without extension",
            ));
        }
        if !folder && name != "-" {
            refuse_taken(Path::new(name), overwrite)?;
        }
        Ok(())
    }

    pub(crate) fn open(
        name: &str,
        capture: &Capture,
        run: FolderRun,
        tiff: TiffSamples,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let (path, size) = (Path::new(name), capture.size());
        if name == "-" {
            write_y4m_header(size, capture.fps())?;
            return Ok(Self::Pipe);
        }
        if path.extension().is_none() {
            return Ok(Self::Folder(FrameFolder::open(path, size, run, overwrite)?));
        }
        Ok(Self::File(Some(ClipWriter::create(path, size, tiff, overwrite)?)))
    }

    /// Frames from the start of `range` on that an earlier run finished.
    pub(crate) fn finished(&self, range: Range<u64>) -> u64 {
        match self {
            Self::Folder(folder) => folder.finished(range),
            _ => 0,
        }
    }

    pub(crate) fn sink<'a>(
        &'a mut self,
        misfit: Option<&'a mut Misfit>,
        deviation: &'a mut Deviation,
    ) -> Sink<'a> {
        Sink { output: self, misfit, deviation }
    }

    /// Gives a file its name, or notes in the folder's manifest that it is complete.
    pub(crate) fn finish(&mut self, results: &Value, complete: bool) -> Result<()> {
        match self {
            Self::Folder(folder) if complete => Ok(folder.finish(results)?),
            Self::Folder(_) | Self::Pipe => Ok(()),
            Self::File(writer) => Ok(writer.take().map_or(Ok(()), ClipWriter::finish)?),
        }
    }
}

pub(crate) struct Sink<'a> {
    output: &'a mut Output,
    misfit: Option<&'a mut Misfit>,
    deviation: &'a mut Deviation,
}

impl RestoreSink for Sink<'_> {
    fn uncertainty(&mut self, _: u64, deviation: &Frame) -> qudi_core::Result<()> {
        self.deviation.push(deviation)
    }

    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        // What a reader of the file will see is what is judged.
        let seen = match &mut *self.output {
            Output::Folder(folder) => Some(folder.push(number, restored)?),
            Output::File(writer) => {
                writer.as_mut().map_or(Ok(()), |writer| writer.push(restored))?;
                None
            }
            Output::Pipe => {
                write_y4m_frame(restored)
                    .map_err(|e| SimError::io("write to", Path::new("standard output"), e))?;
                None
            }
        };
        match &mut self.misfit {
            Some(misfit) => misfit.add(seen.as_ref().unwrap_or(restored), counts),
            None => Ok(()),
        }
    }
}

/// What is seen of the result: chi-square of all frames, and three of them beside their counts.
pub(crate) struct Misfit {
    consistency: Consistency,
    acquisition: Acquisition,
    /// Frames to show; of a pipe that has not told its length, the first.
    shown: Vec<u64>,
    /// Frames that are shown: number, counts, restored.
    pictures: Vec<(u64, [Frame; 2])>,
    /// Whether the latest frame is kept, which may turn out to be the last.
    keep_latest: bool,
    judged: u64,
}

impl Misfit {
    pub(crate) fn new(capture: &Capture, acquisition: &Acquisition) -> Self {
        let length = capture.length();
        let mut shown = vec![0];
        shown.extend(length.into_iter().flat_map(|n| [(n - 1) / 2, n - 1]));
        shown.dedup();
        Self {
            consistency: Consistency::new(capture.size(), acquisition),
            acquisition: acquisition.clone(),
            shown,
            pictures: Vec::new(),
            keep_latest: length.is_none(),
            judged: 0,
        }
    }

    fn add(&mut self, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        if self.keep_latest || self.shown.contains(&self.judged) {
            if self.keep_latest {
                self.pictures.truncate(self.shown.len());
            }
            let full = f32::from(self.acquisition.sensor.max_count());
            let data = counts.iter().map(|&count| f32::from(count) / full).collect();
            let counts = Frame { size: restored.size, data };
            self.pictures.push((self.judged, [counts, restored.clone()]));
        }
        self.judged += 1;
        self.consistency.add(restored, counts, &self.acquisition).map(drop)
    }

    /// Takes in frames that an earlier run finished.
    pub(crate) fn read_finished(
        &mut self,
        output: &Output,
        capture: &mut Capture,
        frames: Range<u64>,
    ) -> Result<()> {
        let Output::Folder(folder) = output else { return Ok(()) };
        let mut counts = vec![0; capture.size().pixels()];
        for frame in frames {
            capture.read(frame, &mut counts)?;
            self.add(&folder.read(frame)?, &counts)?;
        }
        Ok(())
    }

    pub(crate) fn chi_square(&self) -> Option<f64> {
        self.consistency.chi_square()
    }

    /// Counts above, restored frames below: the first, the middle (not of a pipe without length) and
    /// the last.
    pub(crate) fn side_by_side(&self) -> Option<Picture> {
        let size = self.pictures.first()?.1[0].size;
        let mut picture = Picture::new(size, 2, self.pictures.len(), 1);
        for (column, (frame, pair)) in self.pictures.iter().enumerate() {
            picture.place(0, column, &[&format!("COUNTS {frame}")], &pair[0]);
            picture.place(1, column, &[&format!("RESTORED {frame}")], &pair[1]);
        }
        Some(picture)
    }

    pub(crate) fn map(&self) -> Frame {
        self.consistency.map()
    }
}

fn write_y4m_header(size: Size, fps: Option<f64>) -> Result<()> {
    // Frame rates of thousands confuse players; without one, 25 is customary.
    let fps = fps.map_or(25, |fps| fps.round().max(1.0) as u64);
    // Without the tag, readers take luma for the limited range of video, 16 to 235.
    let header = format!(
        "YUV4MPEG2 W{} H{} F{fps}:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n",
        size.width, size.height
    );
    std::io::stdout().write_all(header.as_bytes()).map_err(crate::error::stdout_fault)
}

fn write_y4m_frame(frame: &Frame) -> std::io::Result<()> {
    let mut bytes = b"FRAME\n".to_vec();
    bytes.extend(frame.data.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8));
    let mut out = std::io::stdout().lock();
    // A live picture must not wait for the next one.
    out.write_all(&bytes).and_then(|()| out.flush())
}
