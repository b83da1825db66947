//! Decoded training data in one file: a ZIP archive of gray 8-bit PNG images with an index, which any tool
//! opens.

use image::{ImageFormat, ImageReader, Limits};
use qudi_core::limits::PACK_ENTRY_BYTES;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// Name of the index in the archive.
pub(super) const INDEX: &str = "index.json";
/// Version of the layout.
pub(super) const VERSION: u32 = 1;

/// A clip, or a still, in a pack.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Clip {
    /// The source that it belongs to.
    pub source: String,
    /// Its name, unique in the source.
    pub name: String,
    /// Frames; 1 for a still.
    pub frames: usize,
    /// Rows and columns.
    pub size: Size,
    /// Mean value over all frames: the exposure.
    pub mean: f64,
}

impl Clip {
    /// Returns the name of a frame's image in the archive.
    pub(super) fn entry(&self, frame: usize) -> String {
        format!("{}/{}/{frame:06}.png", self.source, self.name)
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct Index {
    pub(super) version: u32,
    pub(super) clips: Vec<Clip>,
}

/// An open pack.
#[derive(Debug)]
pub struct Pack {
    archive: ZipArchive<BufReader<File>>,
    path: PathBuf,
    clips: Vec<Clip>,
}

impl Pack {
    /// Opens a pack and reads its index.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read or is no pack.
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| Error::io("open the pack", path, e))?;
        let mut archive =
            ZipArchive::new(BufReader::new(file)).map_err(|e| damaged(path, e.to_string()))?;
        let text = entry(&mut archive, INDEX, path)?;
        let index: Index =
            serde_json::from_slice(&text).map_err(|e| damaged(path, e.to_string()))?;
        if index.version != VERSION {
            let what =
                format!("the pack's layout is {}, this program reads {VERSION}", index.version);
            return Err(Error::data(what, path, "make the pack again from its recipe"));
        }
        for clip in &index.clips {
            let size = Size::new(clip.size.height, clip.size.width, &clip.name);
            if clip.frames == 0 || !(0.0..=1.0).contains(&clip.mean) || size.is_err() {
                return Err(damaged(path, format!("clip `{}` cannot be", clip.name)));
            }
        }
        Ok(Self { archive, path: path.to_owned(), clips: index.clips })
    }

    /// Opens another handle to the same pack, for another thread.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn try_clone(&self) -> Result<Self> {
        Self::open(&self.path)
    }

    /// Returns the clips and stills in it.
    pub fn clips(&self) -> &[Clip] {
        &self.clips
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads a frame of clip `number`.
    ///
    /// # Errors
    /// [`Error`] if the file is damaged there.
    pub fn frame(&mut self, number: usize, frame: usize) -> Result<Frame> {
        let clip = &self.clips[number];
        let name = clip.entry(frame);
        let bytes = entry(&mut self.archive, &name, &self.path)?;
        let mut reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Png);
        let mut limits = Limits::default();
        (limits.max_image_height, limits.max_image_width) =
            (Some(clip.size.height as u32), Some(clip.size.width as u32));
        reader.limits(limits);
        let image =
            reader.decode().map_err(|e| damaged(&self.path, format!("{name}: {e}")))?.into_luma8();
        if (image.height() as usize, image.width() as usize) != (clip.size.height, clip.size.width)
        {
            return Err(damaged(&self.path, format!("{name} has another size than its clip")));
        }
        let data = image.into_raw().into_iter().map(|v| f32::from(v) / 255.0).collect();
        Ok(Frame { size: clip.size, data })
    }
}

/// Reads the bytes of an entry; no more are allocated than are there.
fn entry(archive: &mut ZipArchive<BufReader<File>>, name: &str, path: &Path) -> Result<Vec<u8>> {
    let entry = archive.by_name(name).map_err(|e| damaged(path, format!("{name}: {e}")))?;
    let mut bytes = Vec::new();
    let mut limited = entry.take(PACK_ENTRY_BYTES);
    limited.read_to_end(&mut bytes).map_err(|e| damaged(path, format!("{name}: {e}")))?;
    Ok(bytes)
}

fn damaged(path: &Path, what: impl Into<String>) -> Error {
    let what = format!("not a whole training pack: {}", what.into());
    Error::data(what, path, "make the pack again from its recipe")
}
