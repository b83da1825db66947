//! Decoded training data in one file: a ZIP archive of gray images with an index, which any tool opens.
//!
//! Frames for training are JPEG (quantized, see `frame_codec`), downscaled by `data.source.shrink`;
//! validation clips are PNG, exact, and only the middle that a recipe measures. A pack is decoded once, when
//! it is opened, and stays in memory with one byte per pixel: 0.3 GB for `data/open-scenes.toml`.

use super::pack_index::{Clip, INDEX, Index, PackedSource, damaged};
use qudi_core::limits::PACK_INDEX_BYTES;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result, Size};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zip::ZipArchive;

/// Images decoded at once, at most.
const BATCH_IMAGES: usize = 256;

/// Pixels of images decoded at once, at which a batch ends.
const BATCH_PIXELS: usize = 1 << 25;

/// Bytes of an image at most: two per pixel, and headers.
const IMAGE_BYTES: [u64; 2] = [2, 1 << 16];

/// An open pack. Its clones share the frames.
#[derive(Clone, Debug)]
pub struct Pack(Arc<Contents>);

#[derive(Debug)]
struct Contents {
    path: PathBuf,
    clips: Vec<Clip>,
    /// Number of each clip's first frame.
    first: Vec<usize>,
    means: Vec<f64>,
    frames: Vec<Vec<u8>>,
    /// Digest of everything in it.
    sha256: String,
}

/// A frame of a pack, with 8 bits per pixel.
#[derive(Clone, Copy, Debug)]
pub struct PackedFrame<'a> {
    /// Rows and columns.
    pub size: Size,
    /// Gray values, row by row.
    pub values: &'a [u8],
}

impl Pack {
    /// Opens a pack made from `sources`, and decodes it on all cores.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, is damaged, was made from other sources, or is too large.
    pub fn open(path: &Path, sources: &[PackedSource]) -> Result<Self> {
        let file = open_regular(path, "open the pack")?;
        let bytes = file.metadata().map_err(|e| Error::io("open the pack", path, e))?.len();
        let mut archive =
            ZipArchive::new(BufReader::new(file)).map_err(|e| damaged(path, e.to_string()))?;
        let text = entry(&mut archive, INDEX, PACK_INDEX_BYTES, path)?;
        let index = Index::parse(&text, path)?;
        index.check_sources(sources, path)?;
        index.check_sizes(bytes, archive.len().saturating_sub(1), path)?;

        let mut first = Vec::with_capacity(index.clips.len());
        let mut images = Vec::with_capacity(archive.len());
        for clip in &index.clips {
            first.push(images.len());
            images.extend((0..clip.frames).map(|frame| (clip, frame)));
        }
        let mut frames = Vec::with_capacity(images.len());
        let mut digest = Sha256::new();
        while frames.len() < images.len() {
            let rest = &images[frames.len()..];
            let batch = read_batch(&mut archive, &index, rest, path)?;
            for image in &batch {
                digest.update(image);
            }
            let decode = |(&(clip, frame), image): (&(&Clip, usize), &Vec<u8>)| {
                let codec = index.source(clip).expect("checked in the index").codec();
                let fault = |e| damaged(path, format!("{}: {e}", index.entry(clip, frame)));
                codec.decode(image, clip.size).map_err(fault)
            };
            let decoded: Result<Vec<_>> =
                rest[..batch.len()].par_iter().zip(&batch).map(decode).collect();
            frames.extend(decoded?);
        }
        index.check_digest(digest, path)?;

        let sha256 = index.sha256().to_owned();
        let clips = index.clips;
        let mean = |(clip, &first): (&Clip, &usize)| {
            let values = frames[first..first + clip.frames].iter().flatten();
            let sum: u64 = values.map(|&value| u64::from(value)).sum();
            sum as f64 / 255.0 / (clip.frames * clip.size.pixels()) as f64
        };
        let means = clips.par_iter().zip(&first).map(mean).collect();
        let path = path.to_owned();
        Ok(Self(Arc::new(Contents { path, clips, first, means, frames, sha256 })))
    }

    /// Returns the digest of everything in it.
    pub fn sha256(&self) -> &str {
        &self.0.sha256
    }

    /// Returns the clips and stills in it.
    pub fn clips(&self) -> &[Clip] {
        &self.0.clips
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.0.path
    }

    /// Returns the mean value over all frames of clip `number`: its exposure.
    pub fn mean(&self, number: usize) -> f64 {
        self.0.means[number]
    }

    /// Returns a frame of clip `number`.
    ///
    /// # Panics
    /// Panics if the clip has no such frame.
    pub fn frame(&self, number: usize, frame: usize) -> PackedFrame<'_> {
        let clip = &self.0.clips[number];
        assert!(frame < clip.frames, "frame {frame} of {}", clip.frames);
        PackedFrame { size: clip.size, values: &self.0.frames[self.0.first[number] + frame] }
    }
}

impl PackedFrame<'_> {
    /// Returns the value of a pixel, from 0 to 1.
    #[inline]
    pub fn value(self, x: usize, y: usize) -> f32 {
        f32::from(self.values[y * self.size.width + x]) / 255.0
    }
}

/// Reads the next images, as many as are decoded at once.
fn read_batch(
    archive: &mut ZipArchive<BufReader<File>>,
    index: &Index,
    images: &[(&Clip, usize)],
    path: &Path,
) -> Result<Vec<Vec<u8>>> {
    let (mut batch, mut pixels) = (Vec::new(), 0);
    for &(clip, frame) in images.iter().take(BATCH_IMAGES) {
        let limit = IMAGE_BYTES[0] * clip.size.pixels() as u64 + IMAGE_BYTES[1];
        batch.push(entry(archive, &index.entry(clip, frame), limit, path)?);
        pixels += clip.size.pixels();
        if pixels >= BATCH_PIXELS {
            break;
        }
    }
    Ok(batch)
}

/// Reads an entry of at most `limit` bytes; no more are allocated than are there.
fn entry(
    archive: &mut ZipArchive<BufReader<File>>,
    name: &str,
    limit: u64,
    path: &Path,
) -> Result<Vec<u8>> {
    let fault = |e: &dyn std::fmt::Display| damaged(path, format!("{name}: {e}"));
    let mut entry = archive.by_name(name).map_err(|e| fault(&e))?.take(limit + 1);
    let mut bytes = Vec::new();
    entry.read_to_end(&mut bytes).map_err(|e| fault(&e))?;
    if bytes.len() as u64 > limit {
        return Err(fault(&format!("it has more than {limit} bytes")));
    }
    Ok(bytes)
}
