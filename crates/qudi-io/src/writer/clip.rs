//! Frames in [0, 1] on disk: `.npy` of float32, 16-bit or float TIFF, GIF, MP4, or a folder of 16-bit PNG.

use super::array::ArrayWriter;
use super::gif::GifWriter;
use super::mp4::Mp4Writer;
use super::tiff_stack::{TiffSamples, TiffStack};
use super::{frame_name, is_frame_below};
use crate::restore::MANIFEST;
use image::{ImageBuffer, Luma, Rgb};
use qudi_core::atomic_file::{Overwrite, OwnFolder, PendingFolder};
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::path::Path;

/// A folder of frames, with a manifest that says how many.
const FRAMES: OwnFolder = OwnFolder {
    manifest: MANIFEST,
    is_named: |manifest, name| {
        manifest["frames"].as_u64().is_some_and(|frames| is_frame_below(name, frames))
    },
};

/// The planes of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Planes {
    /// One of gray values.
    Gray,
    /// Red, green and blue.
    Rgb,
}

/// A clip of images as a TIFF stack.
pub struct TiffWriter {
    stack: TiffStack,
    samples: TiffSamples,
}

impl std::fmt::Debug for TiffWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TiffWriter").field("samples", &self.samples).finish_non_exhaustive()
    }
}

/// A clip being written, frame by frame.
#[derive(Debug)]
pub enum ClipWriter {
    /// `.npy`, `[frames][height][width]` float32, with 3 colours last if any.
    Array(ArrayWriter),
    /// Multi-page TIFF.
    Tiff(TiffWriter),
    /// Animated GIF, the first frames of a long clip.
    Gif(GifWriter),
    /// MP4, for looking at.
    Mp4Writer(Mp4Writer),
    /// Folder of 16-bit PNG; 65535 is 1.
    Folder {
        /// The folder.
        folder: PendingFolder,
        /// Number of frames so far.
        frames: u64,
    },
}

impl ClipWriter {
    /// Starts a clip of frames of `size`: a `.npy`, `.tif`, `.gif`, `.mp4`, or a folder if the name has no
    /// extension. Frames are gray or of three `planes`. `tiff` gives the samples of a `.tif`, `fps` the rate
    /// at which `.gif` and `.mp4` play.
    ///
    /// # Errors
    /// [`Error`] for other extensions, or if the name is taken or the folder cannot be written.
    pub fn create(
        path: &Path,
        size: Size,
        planes: Planes,
        tiff: TiffSamples,
        fps: f64,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let gray_shape = [size.height, size.width];
        let shape = [size.height, size.width, 3];
        match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
            Some("npy") => {
                let shape = if planes == Planes::Gray { &gray_shape[..] } else { &shape };
                ArrayWriter::create(path, overwrite, "<f4", shape).map(Self::Array)
            }
            Some("tif" | "tiff") => {
                let stack = TiffStack::create(path, size, overwrite)?;
                Ok(Self::Tiff(TiffWriter { stack, samples: tiff }))
            }
            Some("gif") => GifWriter::create(path, overwrite, size, u16::MAX, fps).map(Self::Gif),
            Some("mp4") => {
                Mp4Writer::create(path, size, planes, fps, overwrite).map(Self::Mp4Writer)
            }
            None => {
                let folder = PendingFolder::create(path, overwrite, FRAMES)?;
                Ok(Self::Folder { folder, frames: 0 })
            }
            Some(other) => Err(Error::data(
                format!("frames are not written as .{other}"),
                path,
                "use .npy, .tif, .gif, .mp4, or a name without extension for a folder of 16-bit PNG",
            )),
        }
    }

    /// Adds one frame.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push(&mut self, frame: &Frame) -> Result<()> {
        match self {
            Self::Array(array) => array.push_f32(frame.data.iter().copied()),
            Self::Tiff(TiffWriter { stack, samples: TiffSamples::U16 }) => {
                stack.push_u16(&sixteen_bits(frame))
            }
            Self::Tiff(TiffWriter { stack, samples: TiffSamples::F32 }) => {
                stack.push_f32(&frame.data)
            }
            Self::Gif(gif) => gif.push(&sixteen_bits(frame)),
            Self::Mp4Writer(film) => film.push(frame),
            Self::Folder { folder, frames } => {
                let file = folder.file(&frame_name(*frames));
                *frames += 1;
                save_png16(frame, &file)
                    .map_err(|e| Error::io("write a frame into", folder.path(), e))
            }
        }
    }

    /// Adds one frame of three planes: red, green and blue.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push_colour(&mut self, planes: &[Frame; 3]) -> Result<()> {
        match self {
            Self::Array(array) => array.push_f32(interleaved(planes).into_iter()),
            Self::Tiff(TiffWriter { stack, samples: TiffSamples::U16 }) => {
                let samples: Vec<u16> = interleaved(planes).into_iter().map(to_u16).collect();
                stack.push_rgb16(&samples)
            }
            Self::Tiff(TiffWriter { stack, samples: TiffSamples::F32 }) => {
                stack.push_rgb_f32(&interleaved(planes))
            }
            Self::Gif(gif) => gif.push_colour(interleaved(planes).into_iter().map(to_u8).collect()),
            Self::Mp4Writer(film) => film.push_values(&interleaved(planes)),
            Self::Folder { folder, frames } => {
                let file = folder.file(&frame_name(*frames));
                *frames += 1;
                encode_colour_png16(planes)
                    .and_then(|png| std::fs::write(&file, png))
                    .map_err(|e| Error::io("write a frame into", folder.path(), e))
            }
        }
    }

    /// Gives the clip its name.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn finish(self) -> Result<()> {
        match self {
            Self::Array(array) => array.finish(),
            Self::Tiff(writer) => writer.stack.finish(),
            Self::Gif(gif) => gif.finish(),
            Self::Mp4Writer(film) => film.finish(),
            Self::Folder { folder, frames } => {
                let program = concat!("qudi ", env!("CARGO_PKG_VERSION"));
                let manifest = serde_json::json!({ "program": program, "frames": frames });
                folder.finish(format!("{manifest:#}\n").as_bytes())
            }
        }
    }
}

/// Writes a frame as 16-bit gray PNG into a file; 65535 is 1.
fn save_png16(frame: &Frame, path: &Path) -> std::io::Result<()> {
    std::fs::write(path, encode_png16(frame)?)
}

/// Encodes a frame as 16-bit gray PNG; 65535 is 1.
pub(crate) fn encode_png16(frame: &Frame) -> std::io::Result<Vec<u8>> {
    let samples = sixteen_bits(frame);
    let image = ImageBuffer::<Luma<u16>, _>::from_raw(
        frame.size.width as u32,
        frame.size.height as u32,
        samples,
    );
    let image = image.expect("a frame holds all its pixels");
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, image::ImageFormat::Png).map_err(std::io::Error::other)?;
    Ok(png.into_inner())
}

/// Encodes a frame of red, green and blue as 16-bit PNG; 65535 is 1.
pub(crate) fn encode_colour_png16(planes: &[Frame; 3]) -> std::io::Result<Vec<u8>> {
    let Size { height, width } = planes[0].size;
    let samples: Vec<u16> = interleaved(planes).into_iter().map(to_u16).collect();
    let image = ImageBuffer::<Rgb<u16>, _>::from_raw(width as u32, height as u32, samples);
    let image = image.expect("a frame holds all its pixels");
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, image::ImageFormat::Png).map_err(std::io::Error::other)?;
    Ok(png.into_inner())
}

/// Returns the samples of three planes pixel by pixel.
fn interleaved([red, green, blue]: &[Frame; 3]) -> Vec<f32> {
    let pixels = red.data.iter().zip(&green.data).zip(&blue.data);
    pixels.flat_map(|((&r, &g), &b)| [r, g, b]).collect()
}

fn to_u8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn to_u16(value: f32) -> u16 {
    (value.clamp(0.0, 1.0) * 65535.0).round() as u16
}

fn sixteen_bits(frame: &Frame) -> Vec<u16> {
    frame.data.iter().copied().map(to_u16).collect()
}
