//! Decoding of a recipe's sources into a pack.

use super::config::{DataConfig, SourceKind};
use super::content::contents;
use super::pack::{Clip, INDEX, Index, VERSION};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use qudi_core::Frame;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use qudi_sim::clip::{Input, Sampling};
use rayon::prelude::*;
use std::io::Write;
use std::ops::ControlFlow;
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Frames encoded at once.
const BATCH: usize = 16;

/// A clip that has been packed.
#[derive(Clone, Debug)]
pub struct PackProgress {
    /// The clip.
    pub clip: Clip,
    /// Clips done, and in all.
    pub done: [usize; 2],
}

/// Decodes every clip and still that `configs` name, below the folder `data`, into one pack. `most` frames of
/// a clip are taken at most. `on` receives every clip, and returns `Break` to stop.
///
/// # Errors
/// [`Error`] if something cannot be read or written; [`Error::Interrupted`] if asked to stop.
pub fn write_pack(
    configs: &[&DataConfig],
    data: &Path,
    path: &Path,
    overwrite: Overwrite,
    on: &mut dyn FnMut(&PackProgress) -> ControlFlow<()>,
) -> Result<()> {
    let mut jobs = Vec::new();
    for source in configs.iter().flat_map(|config| &config.source) {
        if source.kind != SourceKind::Scenes {
            let found = contents(source, data)?;
            jobs.extend(found.into_iter().map(|content| (source, content)));
        }
    }
    let file = PendingFile::create(path, overwrite)?;
    let mut zip = ZipWriter::new_stream(file);
    let mut clips: Vec<Clip> = Vec::new();
    let total = jobs.len();
    for (source, content) in jobs {
        let input = match source.kind {
            SourceKind::Stills => Input::still(&content.path),
            _ => Input::clip(&content.path)?,
        };
        let frames = (source.kind == SourceKind::Stills).then_some(1);
        let mut reader = input.open(&Sampling { frames, ..Sampling::default() })?;
        let mut clip = Clip {
            source: source.name.clone(),
            name: content.name,
            frames: 0,
            size: reader.info().size,
            mean: 0.0,
        };
        if clips.iter().any(|other| other.source == clip.source && other.name == clip.name) {
            return Err(Error::data(
                format!("source `{}` holds `{}` twice", clip.source, clip.name),
                &content.path,
                "name every file once",
            ));
        }
        loop {
            let mut batch = Vec::with_capacity(BATCH);
            while batch.len() < BATCH {
                let Some(mean_level) = reader.next()? else { break };
                batch.push(mean_level.truth().clone());
            }
            if batch.is_empty() {
                break;
            }
            let images: Vec<_> = batch.par_iter().map(png).collect();
            for (frame, image) in batch.iter().zip(images) {
                store(&mut zip, &clip.entry(clip.frames), &image?, path)?;
                clip.mean += frame.mean();
                clip.frames += 1;
            }
        }
        clip.mean /= clip.frames.max(1) as f64;
        clips.push(clip.clone());
        if on(&PackProgress { clip, done: [clips.len(), total] }).is_break() {
            return Err(Error::Interrupted);
        }
    }
    let index = serde_json::to_vec_pretty(&Index { version: VERSION, clips }).expect("plain data");
    store(&mut zip, INDEX, &index, path)?;
    zip.finish().map_err(|e| failed(path, e))?.into_inner().finish()
}

/// Encodes a frame as an 8-bit gray PNG.
fn png(frame: &Frame) -> Result<Vec<u8>> {
    let bytes: Vec<u8> = frame.data.iter().map(|v| (v * 255.0).round() as u8).collect();
    let mut image = Vec::new();
    let encoder =
        PngEncoder::new_with_quality(&mut image, CompressionType::Best, FilterType::Adaptive);
    let (width, height) = (frame.size.width as u32, frame.size.height as u32);
    let done = encoder.write_image(&bytes, width, height, ExtendedColorType::L8);
    done.map_err(|e| {
        Error::request(format!("a frame cannot be encoded: {e}"), frame.size, "report this")
    })?;
    Ok(image)
}

/// Returns the options of entries: images are compressed already.
fn store<W: Write>(
    zip: &mut ZipWriter<zip::write::StreamWriter<W>>,
    name: &str,
    bytes: &[u8],
    path: &Path,
) -> Result<()> {
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(zip::DateTime::default());
    zip.start_file(name, options).map_err(|e| failed(path, e))?;
    zip.write_all(bytes).map_err(|e| Error::io("write the pack", path, e))
}

fn failed(path: &Path, error: zip::result::ZipError) -> Error {
    match error {
        zip::result::ZipError::Io(e) => Error::io("write the pack", path, e),
        other => Error::data(format!("cannot write the pack: {other}"), path, "report this"),
    }
}
