//! An animated GIF of what was recorded or restored, for a quick look.

use qudi_core::Size;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use std::path::Path;

/// A growing GIF.
pub struct GifWriter {
    encoder: gif::Encoder<PendingFile>,
    size: (u16, u16),
    full_scale: f32,
    frames: usize,
    /// Hundredths of a second per frame.
    delay: u16,
}

impl std::fmt::Debug for GifWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GifWriter").field("frames", &self.frames).finish_non_exhaustive()
    }
}

/// Least time of a frame in hundredths of a second: browsers slow down faster ones.
const MIN_DELAY: f64 = 2.0;

/// Speed of the choice of 256 colours, from 1 (best) to 30.
const PALETTE_SPEED: i32 = 10;

/// Largest number of frames: longer previews would be larger than the data.
const MAX_FRAMES: usize = 200;

impl GifWriter {
    /// Starts a preview of frames whose brightest value is `full_scale`, `fps` of them per second (50 at
    /// most).
    ///
    /// # Errors
    /// [`Error`] if the name is taken, the folder cannot be written, or frames are too large.
    pub fn create(
        path: &Path,
        overwrite: Overwrite,
        size: Size,
        full_scale: u16,
        fps: f64,
    ) -> Result<Self> {
        let (Ok(width), Ok(height)) = (u16::try_from(size.width), u16::try_from(size.height))
        else {
            return Err(Error::data(
                format!("frames of {size} do not fit into a GIF"),
                path,
                "GIF ends at 65535 pixels: leave out `preview`",
            ));
        };
        let file = PendingFile::create(path, overwrite)?;
        let palette: Vec<u8> = (0..=255u8).flat_map(|v| [v, v, v]).collect();
        let mut encoder =
            gif::Encoder::new(file, width, height, &palette).map_err(|e| fault(path, e))?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(|e| fault(path, e))?;
        let delay = (100.0 / fps).round().max(MIN_DELAY) as u16;
        let full_scale = f32::from(full_scale);
        Ok(Self { encoder, size: (width, height), full_scale, frames: 0, delay })
    }

    /// Adds a frame of counts; those after the 200th are left out.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn push(&mut self, counts: &[u16]) -> Result<()> {
        if self.frames == MAX_FRAMES {
            return Ok(());
        }
        self.frames += 1;
        let gray = |&c: &u16| (f32::from(c) / self.full_scale * 255.0).round() as u8;
        let mut frame = gif::Frame {
            width: self.size.0,
            height: self.size.1,
            delay: self.delay,
            buffer: counts.iter().map(gray).collect(),
            ..gif::Frame::default()
        };
        frame.make_lzw_pre_encoded();
        let path = self.encoder.get_ref().path().to_owned();
        self.encoder.write_lzw_pre_encoded_frame(&frame).map_err(|e| fault(&path, e))
    }

    /// Adds a frame of red, green and blue samples, in the 256 colours that suit it best.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub(super) fn push_colour(&mut self, samples: Vec<u8>) -> Result<()> {
        if self.frames == MAX_FRAMES {
            return Ok(());
        }
        self.frames += 1;
        let (width, height) = self.size;
        let mut frame = gif::Frame::from_rgb_speed(width, height, &samples, PALETTE_SPEED);
        frame.delay = self.delay;
        frame.make_lzw_pre_encoded();
        let path = self.encoder.get_ref().path().to_owned();
        self.encoder.write_lzw_pre_encoded_frame(&frame).map_err(|e| fault(&path, e))
    }

    /// Gives the file its name.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full.
    pub fn finish(self) -> Result<()> {
        let path = self.encoder.get_ref().path().to_owned();
        let file = self.encoder.into_inner().map_err(|e| fault(&path, e))?;
        file.finish()
    }
}

fn fault(path: &Path, e: gif::EncodingError) -> Error {
    match e {
        gif::EncodingError::Io(e) => Error::io("write", path, e),
        other => Error::io("write", path, std::io::Error::other(other)),
    }
}
