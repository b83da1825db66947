//! Frames in [0, 1] on disk: `.npy` of float32, or a folder of 16-bit PNG.

use super::array::ArrayWriter;
use super::pending::{Overwrite, PendingFolder};
use crate::error::{Result, SimError};
use crate::frame::{Frame, Size};
use image::{ImageBuffer, Luma};
use std::path::Path;

/// The first file of a folder; it also marks the folder as ours.
const FIRST: &str = "frame_000000.png";

/// A clip being written, frame by frame.
#[derive(Debug)]
pub enum FramesWriter {
    /// `.npy`, `[frames][height][width]` float32.
    Array(ArrayWriter),
    /// Folder of 16-bit PNG; 65535 is 1.
    Folder {
        /// The folder.
        folder: PendingFolder,
        /// Frames so far.
        frames: usize,
    },
}

impl FramesWriter {
    /// Starts a clip of frames of `size`: a `.npy`, or a folder if the name has no extension.
    ///
    /// # Errors
    /// [`SimError`] for other extensions, or if the name is taken or the folder cannot be written.
    pub fn create(path: &Path, size: Size, overwrite: Overwrite) -> Result<Self> {
        match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
            Some("npy") => ArrayWriter::create(path, overwrite, "<f4", &[size.height, size.width])
                .map(Self::Array),
            None => {
                let folder = PendingFolder::create(path, overwrite, FIRST)?;
                Ok(Self::Folder { folder, frames: 0 })
            }
            Some(other) => Err(SimError::data(
                format!("frames are not written as .{other}"),
                path,
                "use .npy, or a name without extension for a folder of 16-bit PNG",
            )),
        }
    }

    /// Adds one frame.
    ///
    /// # Errors
    /// [`SimError::Io`] if the disk is full.
    pub fn push(&mut self, frame: &Frame) -> Result<()> {
        match self {
            Self::Array(array) => array.push_f32(frame.data.iter().copied()),
            Self::Folder { folder, frames } => {
                let file = folder.file(&format!("frame_{frames:06}.png"));
                *frames += 1;
                save_png16(frame, &file)
                    .map_err(|e| SimError::io("write a frame into", folder.path(), e))
            }
        }
    }

    /// Gives the clip its name.
    ///
    /// # Errors
    /// [`SimError::Io`] if the disk is full.
    pub fn finish(self) -> Result<()> {
        match self {
            Self::Array(array) => array.finish(),
            Self::Folder { folder, .. } => folder.finish(),
        }
    }
}

fn save_png16(frame: &Frame, path: &Path) -> std::io::Result<()> {
    let samples: Vec<u16> =
        frame.data.iter().map(|v| (v.clamp(0.0, 1.0) * 65535.0).round() as u16).collect();
    let image = ImageBuffer::<Luma<u16>, _>::from_raw(
        frame.size.width as u32,
        frame.size.height as u32,
        samples,
    );
    image.expect("a frame holds all its pixels").save(path).map_err(std::io::Error::other)
}
