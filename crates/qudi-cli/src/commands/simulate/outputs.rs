//! Where the frames of a simulation go.

use super::plan::OutputPlan;
use crate::colour::{encoded, is_linear};
use crate::error::{CliError, Result};
use qudi_core::Error;
use qudi_core::atomic_file::PendingFile;
use qudi_core::flow::Flow;
use qudi_io::sidecar::Record;
use qudi_io::writer::{ArrayWriter, BurstWriter, ClipWriter, GifWriter, write_npy_stream};
use qudi_sim::{Exposed, Sink, Start};
use serde_json::{Value, json};
use std::io::{Write, stdout};
use std::path::{Path, PathBuf};

/// Frames per second of previews.
const PREVIEW_FPS: f64 = 20.0;

/// Counts of a frame as the bytes of a stream.
type FrameEncoder = Box<dyn Fn(&[u16]) -> Vec<u8>>;

/// Outputs of one simulation.
pub(super) struct Outputs<'a> {
    plan: &'a OutputPlan,
    burst: Option<BurstWriter>,
    stream: Option<FrameEncoder>,
    truth: Option<ClipWriter>,
    flow: Option<ArrayWriter>,
    preview: Option<GifWriter>,
}

impl<'a> Outputs<'a> {
    /// Takes the outputs of a plan; nothing is opened yet.
    pub(super) fn new(plan: &'a OutputPlan) -> Self {
        Self { plan, burst: None, stream: None, truth: None, flow: None, preview: None }
    }

    /// Gives everything its name, side outputs first, the burst and its record last.
    pub(super) fn finish(self, record: &Record) -> Result<Vec<PathBuf>> {
        let mut written = Vec::new();
        if let (Some(truth), Some(path)) = (self.truth, &self.plan.truth) {
            truth.finish()?;
            written.push(path.clone());
        }
        if let (Some(flow), Some(path)) = (self.flow, &self.plan.flow) {
            flow.finish()?;
            written.push(path.clone());
        }
        if let (Some(preview), Some(path)) = (self.preview, &self.plan.preview) {
            preview.finish()?;
            written.push(path.clone());
        }
        let path = PathBuf::from(&self.plan.output);
        if let Some(transforms) = &self.plan.transforms {
            let document = serde_json::to_vec(&visionsim_transforms(record, &path));
            let document = document
                .map_err(|e| CliError::new(e, transforms.display(), "report this as a bug"))?;
            PendingFile::write_whole(transforms, &document, self.plan.overwrite)?;
            written.push(transforms.clone());
        }
        if let Some(burst) = self.burst {
            let json = serde_json::to_vec_pretty(record)
                .map_err(|e| CliError::new(e, &self.plan.output, "report this as a bug"))?;
            let record_path = self.plan.format.record_path(&path);
            burst.finish(&json, self.plan.overwrite)?;
            written.splice(0..0, [path, record_path]);
        }
        Ok(written)
    }
}

impl Sink for Outputs<'_> {
    fn start(&mut self, start: Start) -> qudi_core::Result<()> {
        let (plan, overwrite) = (self.plan, self.plan.overwrite);
        let max_count = plan.max_count;
        if plan.to_stdout() {
            let stream = write_npy_stream(
                &mut stdout().lock(),
                self.plan.format,
                start.frames as usize,
                start.size,
            );
            let stream = stream.map_err(|e| Error::io("write", Path::new("standard output"), e))?;
            self.stream = Some(Box::new(stream));
        } else {
            let path = Path::new(&plan.output);
            self.burst = Some(BurstWriter::create(
                path,
                self.plan.format,
                start.size,
                max_count,
                overwrite,
            )?);
        }
        let create = |path: &PathBuf| {
            ClipWriter::create(path, start.size, plan.planes, plan.tiff, PREVIEW_FPS, overwrite)
        };
        self.truth = plan.truth.as_ref().map(create).transpose()?;
        let create = |path: &PathBuf| {
            ArrayWriter::create(path, overwrite, "<f4", &[3, start.size.height, start.size.width])
        };
        self.flow = plan.flow.as_ref().map(create).transpose()?;
        let create =
            |path: &PathBuf| GifWriter::create(path, overwrite, start.size, max_count, PREVIEW_FPS);
        self.preview = plan.preview.as_ref().map(create).transpose()?;
        Ok(())
    }

    fn frame(
        &mut self,
        exposed: Exposed<'_>,
        flow: &dyn Fn() -> Option<Flow>,
    ) -> qudi_core::Result<()> {
        if let Some(burst) = &mut self.burst {
            burst.push(exposed.counts)?;
        }
        if let Some(encode) = &self.stream {
            let written = stdout().lock().write_all(&encode(exposed.counts));
            written.map_err(|e| Error::io("write", Path::new("standard output"), e))?;
        }
        if let (Some(truth), Some(path)) = (&mut self.truth, &self.plan.truth) {
            match exposed.colour {
                Some(colour) if is_linear(path, self.plan.tiff) => truth.push_colour(colour)?,
                Some(colour) => truth.push_colour(&encoded(colour))?,
                None => truth.push(exposed.truth)?,
            }
        }
        if let Some(preview) = &mut self.preview {
            preview.push(exposed.counts)?;
        }
        let Some(array) = &mut self.flow else { return Ok(()) };
        let Some(flow) = flow() else { return Ok(()) };
        let visible = flow.visible.iter().map(|&v| f32::from(u8::from(v)));
        array.push_f32(flow.dx.iter().copied().chain(flow.dy.iter().copied()).chain(visible))
    }
}

/// Returns the document that visionsim needs to unpack the burst: a camera without pose.
fn visionsim_transforms(record: &Record, path: &Path) -> Value {
    let burst = &record.burst;
    let identity = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    let frames: Vec<_> =
        (0..burst.frames).map(|_| json!({ "transform_matrix": identity })).collect();
    json!({
        "file_path": path.file_name().unwrap_or_default().to_string_lossy(),
        "h": burst.size.height, "w": burst.size.width, "c": 1,
        "fl_x": burst.size.width, "fl_y": burst.size.width,
        "cx": burst.size.width as f64 / 2.0, "cy": burst.size.height as f64 / 2.0,
        "bitpack": true, "bitpack_dim": 2,
        "frames": frames,
    })
}
