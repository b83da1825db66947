//! Animated GIF.

use super::FrameReader;
use image::codecs::gif::GifDecoder;
use image::{AnimationDecoder, ImageDecoder};
use qudi_core::Transfer;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::io::BufReader;
use std::path::{Path, PathBuf};

pub(super) struct Gif {
    frames: image::Frames<'static>,
    size: Size,
    path: PathBuf,
    transfer: Transfer,
}

impl Gif {
    pub(super) fn open(path: &Path, transfer: Transfer) -> Result<Self> {
        let file = open_regular(path, "open the GIF")?;
        let decoder = GifDecoder::new(BufReader::new(file)).map_err(|e| damaged(path, &e))?;
        let (width, height) = decoder.dimensions();
        let size = Size::new(height as usize, width as usize, &path.display().to_string())?;
        Ok(Self { frames: decoder.into_frames(), size, path: path.to_owned(), transfer })
    }
}

fn damaged(path: &Path, e: &image::ImageError) -> Error {
    Error::data(format!("not a readable GIF: {e}"), path, "export it again, or as a folder of PNG")
}

impl FrameReader for Gif {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        None
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        let Some(frame) = self.frames.next() else { return Ok(None) };
        let frame = frame.map_err(|e| damaged(&self.path, &e))?;
        let data = frame.buffer().pixels();
        let data =
            data.map(|p| self.transfer.gray([p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0)));
        Ok(Some(Frame { size: self.size, data: data.map(|v| v.min(1.0)).collect() }))
    }
}
