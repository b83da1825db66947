//! The writer of all burst formats, chosen by the name of the output.

mod bits;
mod png_folder;

pub use bits::{pack_row, unpack_row};

use super::{ArrayWriter, TiffStack};
use png_folder::PngFolder;
use qudi_core::Size;
use qudi_core::atomic_file::Overwrite;
use qudi_core::npy::write_header;
use qudi_core::{Error, Result};
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Returns the path of the record of the file at `path`: `NAME.npy.json` for `NAME.npy`.
pub fn beside(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".json");
    name.into()
}

/// The format of counts on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BurstFormat {
    /// `.npy`, `[frames][height][ceil(width / 8)]` bytes, first pixel in the highest bit.
    NpyPacked,
    /// `.npy`, `[frames][height][width]`, one byte per count.
    NpyU8,
    /// `.npy`, `[frames][height][width]`, two little-endian bytes per count.
    NpyU16,
    /// Multi-page TIFF of 8- or 16-bit counts.
    Tiff,
    /// Folder of 8- or 16-bit PNG, values are counts.
    Png,
}

impl BurstFormat {
    /// Returns the format for an output name: `.npy`, `.tif`, `.tiff`, or a folder. Binary `.npy` bursts are
    /// packed if `packed`.
    ///
    /// # Errors
    /// [`Error`] for other extensions.
    pub fn for_path(path: &Path, max_count: u16, packed: bool) -> Result<Self> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match extension.as_deref() {
            Some("npy") => Ok(Self::npy(max_count, packed)),
            Some("tif" | "tiff") => Ok(Self::Tiff),
            None => Ok(Self::Png),
            Some(other) => Err(Error::data(
                format!("bursts are not written as .{other}"),
                path,
                "use .npy, .tif, or a name without extension for a folder of PNG",
            )),
        }
    }

    /// Returns the `.npy` format for counts up to `max_count`.
    pub fn npy(max_count: u16, packed: bool) -> Self {
        match max_count {
            1 if packed => Self::NpyPacked,
            0..=255 => Self::NpyU8,
            _ => Self::NpyU16,
        }
    }

    /// Returns the path of the record of a burst at `path`: next to a file, inside a folder.
    pub fn record_path(self, path: &Path) -> PathBuf {
        if self == Self::Png {
            return path.join(PngFolder::RECORD);
        }
        beside(path)
    }

    /// Returns the NumPy type and the shape of one frame.
    fn item(self, size: Size) -> (&'static str, [usize; 2]) {
        match self {
            Self::NpyPacked => ("|u1", [size.height, size.width.div_ceil(8)]),
            Self::NpyU16 => ("<u2", [size.height, size.width]),
            _ => ("|u1", [size.height, size.width]),
        }
    }

    /// Encodes one frame as bytes of the `.npy` formats.
    fn encode(self, size: Size, counts: &[u16]) -> Vec<u8> {
        match self {
            Self::NpyPacked => {
                let width = size.width.div_ceil(8);
                let mut bytes = vec![0; size.height * width];
                for (row, packed) in counts.chunks(size.width).zip(bytes.chunks_mut(width)) {
                    pack_row(row, packed);
                }
                bytes
            }
            Self::NpyU16 => counts.iter().flat_map(|c| c.to_le_bytes()).collect(),
            _ => counts.iter().map(|&c| c as u8).collect(),
        }
    }
}

/// Bits of a count.
enum Depth {
    Eight,
    Sixteen,
}

enum Target {
    Array(ArrayWriter),
    /// A stack, and the bits of its counts.
    Tiff(TiffStack, Depth),
    Png(PngFolder),
}

/// A burst being written, frame by frame.
pub struct BurstWriter {
    format: BurstFormat,
    size: Size,
    path: PathBuf,
    target: Target,
}

impl std::fmt::Debug for BurstWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BurstWriter")
            .field("format", &self.format)
            .field("path", &self.path)
            .finish_non_exhaustive()
    }
}

impl BurstWriter {
    /// Starts a burst of frames of `size`, counts up to `max_count`.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or the folder cannot be written.
    pub fn create(
        path: &Path,
        format: BurstFormat,
        size: Size,
        max_count: u16,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let target = match format {
            BurstFormat::Tiff => {
                let depth = if max_count > 255 { Depth::Sixteen } else { Depth::Eight };
                Target::Tiff(TiffStack::create(path, size, overwrite)?, depth)
            }
            BurstFormat::Png => Target::Png(PngFolder::create(path, size, max_count, overwrite)?),
            _ => {
                let (descr, item) = format.item(size);
                Target::Array(ArrayWriter::create(path, overwrite, descr, &item)?)
            }
        };
        Ok(Self { format, size, path: path.to_owned(), target })
    }

    /// Adds one frame.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push(&mut self, counts: &[u16]) -> Result<()> {
        match &mut self.target {
            Target::Array(array) => array.push(&self.format.encode(self.size, counts)),
            Target::Tiff(stack, Depth::Sixteen) => stack.push_u16(counts),
            Target::Tiff(stack, Depth::Eight) => {
                let bytes: Vec<u8> = counts.iter().map(|&c| c as u8).collect();
                stack.push_u8(&bytes)
            }
            Target::Png(folder) => folder.push(counts),
        }
    }

    /// Adds packed frames as they are; returns false if the format is not packed `.npy`.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push_packed(&mut self, frames: &[u8]) -> Result<bool> {
        match &mut self.target {
            Target::Array(array) if self.format == BurstFormat::NpyPacked => {
                let frame_bytes = self.size.height * self.size.width.div_ceil(8);
                frames.chunks_exact(frame_bytes).try_for_each(|frame| array.push(frame))?;
                Ok(true)
            }
            _ => Ok(false),
        }
    }

    /// Gives the burst its name, and its record next to it or inside it.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn finish(self, record: &[u8], overwrite: Overwrite) -> Result<()> {
        let record_path = self.format.record_path(&self.path);
        if let Target::Png(folder) = self.target {
            return folder.finish(record);
        }
        let mut file = qudi_core::atomic_file::PendingFile::create(&record_path, overwrite)?;
        file.write_all(record).map_err(|e| file.fault(e))?;
        match self.target {
            Target::Array(array) => array.finish()?,
            Target::Tiff(stack, _) => stack.finish()?,
            Target::Png(_) => {}
        }
        file.finish()
    }
}

/// Writes the `.npy` header of a burst of known length to a pipe, and returns the encoder of frames.
///
/// # Errors
/// The pipe's own.
pub fn write_npy_stream(
    out: &mut dyn Write,
    format: BurstFormat,
    frames: usize,
    size: Size,
) -> std::io::Result<impl Fn(&[u16]) -> Vec<u8> + use<>> {
    let (descr, item) = format.item(size);
    let mut header = Vec::new();
    write_header(&mut header, descr, &[frames, item[0], item[1]])?;
    out.write_all(&header)?;
    Ok(move |counts: &[u16]| format.encode(size, counts))
}
