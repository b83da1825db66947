//! Decoding of a recipe's sources into a pack.

use super::config::SourceKind;
use super::content::{Content, contents};
use super::crop::shrunk;
use super::pack_index::{Clip, ClipWindow, INDEX, Index, PackedSource};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Frame, Result, Size};
use qudi_sim::clip::{Input, Sampling};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::io::Write;
use std::ops::ControlFlow;
use std::path::Path;
use zip::write::{SimpleFileOptions, StreamWriter};
use zip::{CompressionMethod, ZipWriter};

/// Frames encoded at once.
const BATCH: usize = 16;

/// PSNR of a frame without error, which counts so in means.
const EXACT_PSNR: f64 = 60.0;

/// A clip that has been packed.
#[derive(Clone, Debug)]
pub struct PackProgress {
    /// The clip.
    pub clip: Clip,
    /// Clips done, and in all.
    pub done: [usize; 2],
}

/// A frame in its final size: rounded, encoded, and the PSNR of what is decoded from it.
struct Image {
    bytes: Vec<u8>,
    psnr: f64,
}

/// Decodes every clip and still of `sources`, below the folder `data`, into one pack. Returns the mean PSNR
/// of training frames, as decoded from the pack, against their downscaled sources. Clips that cannot be read
/// are left out and named in `skipped`, or refused if there is no such list. `on` receives every clip, and
/// returns `Break` to stop.
///
/// # Errors
/// [`Error`] if something cannot be read or written; [`Error::Interrupted`] if asked to stop.
pub fn write_pack(
    sources: &[PackedSource],
    data: &Path,
    path: &Path,
    overwrite: Overwrite,
    skipped: Option<&mut Vec<String>>,
    on: &mut dyn FnMut(&PackProgress) -> ControlFlow<()>,
) -> Result<Option<f64>> {
    let mut jobs = Vec::new();
    for source in sources {
        jobs.extend(contents(source, data)?.into_iter().map(|content| (source, content)));
    }
    let file = PendingFile::create(path, overwrite)?;
    let mut zip = ZipWriter::new_stream(file);
    let mut index = Index::new(sources.to_vec());
    let mut digest = Sha256::new();
    let (mut psnr, mut count) = (0.0, 0);
    let total = jobs.len();
    let mut unreadable = Vec::new();
    for (source, content) in jobs {
        let (clip, images) = match packed(source, &content) {
            Ok(packed) => packed,
            // All of them are named at once.
            Err(error) => {
                unreadable.push(format!("{} ({error})", content.path.display()));
                continue;
            }
        };
        if index.clips.iter().any(|other| other.source == clip.source && other.name == clip.name) {
            return Err(Error::data(
                format!("source `{}` holds `{}` twice", clip.source, clip.name),
                &content.path,
                "name every file once",
            ));
        }
        for (frame, image) in images.iter().enumerate() {
            store(&mut zip, &index.entry(&clip, frame), &image.bytes, path)?;
            digest.update(&image.bytes);
        }
        if source.lossless.is_none() {
            psnr += images.iter().map(|image| image.psnr).sum::<f64>();
            count += images.len();
        }
        index.clips.push(clip.clone());
        if on(&PackProgress { clip, done: [index.clips.len(), total] }).is_break() {
            return Err(Error::Interrupted);
        }
    }
    let is_left = |source: &PackedSource| index.clips.iter().any(|clip| clip.source == source.name);
    let skipped = skipped.filter(|_| sources.iter().all(is_left));
    if let Some(skipped) = skipped {
        skipped.append(&mut unreadable);
    }
    if !unreadable.is_empty() {
        return Err(Error::data(
            format!(
                "{} of {total} clips cannot be read: {}",
                unreadable.len(),
                unreadable.join("; ")
            ),
            data,
            "repair these files or move them out of the sources (`skip-bad` leaves them out, if a source has others); nothing was packed",
        ));
    }
    store(&mut zip, INDEX, &index.signed(digest), path)?;
    zip.finish().map_err(|e| failed(path, e))?.into_inner().finish()?;
    Ok((count > 0).then(|| psnr / count as f64))
}

/// Reads a clip or a still, and encodes its frames.
fn packed(source: &PackedSource, content: &Content) -> Result<(Clip, Vec<Image>)> {
    let still = source.kind == SourceKind::Stills;
    let input = if still { Input::still(&content.path) } else { Input::clip(&content.path)? };
    let frames = still.then_some(1);
    let mut reader = input.open(&Sampling { frames, ..Sampling::default() })?;
    let mut size = Size { height: 0, width: 0 };
    let mut images = Vec::new();
    loop {
        let mut batch = Vec::with_capacity(BATCH);
        while batch.len() < BATCH {
            let Some(exposure) = reader.next()? else { break };
            batch.push(exposure.truth().clone());
        }
        if batch.is_empty() {
            break;
        }
        let frames: Vec<Frame> = batch.into_par_iter().map(|frame| source.part(frame)).collect();
        size = frames[0].size;
        let encoded: Result<Vec<_>> = frames.par_iter().map(|frame| image(source, frame)).collect();
        images.extend(encoded?);
    }
    if let Some(ClipWindow { frames, .. }) = source.lossless {
        images.drain(..images.len().saturating_sub(frames) / 2);
        images.truncate(frames);
    }
    if images.is_empty() {
        let what = format!("`{}` holds no frame", content.name);
        return Err(Error::data(what, &content.path, "leave it out of the source"));
    }
    let clip = Clip {
        source: source.name.clone(),
        name: content.name.clone(),
        file_bytes: content.bytes()?,
        frames: images.len(),
        size,
    };
    Ok((clip, images))
}

impl PackedSource {
    /// Returns a frame as it is packed: downscaled, or its middle.
    fn part(&self, frame: Frame) -> Frame {
        let Size { height, width } = frame.size;
        if let Some(ClipWindow { crop, .. }) = self.lossless {
            let size = Size { height: height.min(crop), width: width.min(crop) };
            let (top, left) = ((height - size.height) / 2, (width - size.width) / 2);
            return Frame::from_fn(size, |x, y| frame.data[(top + y) * width + left + x]);
        }
        let short = |side: usize| ((side as f64 / self.shrink).round() as usize).max(1);
        shrunk(frame, Size { height: short(height), width: short(width) })
    }
}

/// Encodes a frame.
fn image(source: &PackedSource, frame: &Frame) -> Result<Image> {
    let values: Vec<u8> = frame.data.iter().map(|v| (v * 255.0).round() as u8).collect();
    let bytes = source.codec().encode(&values, frame.size)?;
    let mut psnr = EXACT_PSNR;
    if source.lossless.is_none() {
        let decoded = source.codec().decode(&bytes, frame.size).map_err(|e| {
            let what = format!("an encoded frame cannot be decoded: {e}");
            Error::request(what, &source.name, "report this")
        })?;
        let pairs = frame.data.iter().zip(&decoded);
        let sum: f64 = pairs.map(|(a, &b)| (f64::from(*a) - f64::from(b) / 255.0).powi(2)).sum();
        psnr = psnr.min(-10.0 * (sum / decoded.len() as f64).log10());
    }
    Ok(Image { bytes, psnr })
}

/// Stores an entry; images are compressed already.
fn store<W: Write>(
    zip: &mut ZipWriter<StreamWriter<W>>,
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
