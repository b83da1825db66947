//! Frames in a `.npy` array: `[frames][height][width]`, with 1 or 3 channels last if any.

use super::FrameReader;
use super::image_file::{AssumedWhite, check_values};
use qudi_core::Transfer;
use qudi_core::npy::{Header, Sample};
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::io::Read;
use std::path::{Path, PathBuf};

pub(super) struct NpyFrames {
    reader: Box<dyn Read>,
    sample: Sample,
    size: Size,
    channels: usize,
    left: u64,
    total: u64,
    path: PathBuf,
    transfer: Transfer,
    white: f32,
    assumed_white: AssumedWhite,
}

impl NpyFrames {
    pub(super) fn open(path: &Path, transfer: Transfer, white: Option<f32>) -> Result<Self> {
        let (header, reader) = Header::open(path)?;
        let deep = header.sample.bytes() > 1 && header.sample.full_scale() != Some(1.0);
        let assumed_white = header.sample.full_scale().filter(|_| deep && white.is_none());
        let Some(white) = white.or(header.sample.full_scale()) else {
            return Err(Error::data(
                "an array of wide integers, whose value of white is unknown",
                path,
                "give the value of white, such as 255",
            ));
        };
        let (frames, height, width, channels) = match *header.shape.as_slice() {
            [h, w] => (1, h, w, 1),
            [t, h, w] => (t, h, w, 1),
            [t, h, w, c @ (1 | 3)] => (t, h, w, c),
            _ => {
                return Err(Error::data(
                    format!("an array of shape {:?} is no clip", header.shape),
                    path,
                    "save an array of shape (frames, height, width) or (frames, height, width, 3)",
                ));
            }
        };
        if frames == 0 {
            return Err(Error::data("the array holds no frames", path, "save at least one frame"));
        }
        Ok(Self {
            reader: header.in_c_order(reader, path)?,
            sample: header.sample,
            size: Size::new(height, width, &path.display().to_string())?,
            channels,
            left: frames as u64,
            total: frames as u64,
            path: path.to_owned(),
            transfer,
            white,
            assumed_white,
        })
    }
}

impl FrameReader for NpyFrames {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        Some(self.total)
    }

    fn assumed_white(&mut self) -> Result<AssumedWhite> {
        Ok(self.assumed_white)
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        let bytes = self.sample.bytes();
        let mut raw = vec![0u8; self.size.pixels() * self.channels * bytes];
        self.reader.read_exact(&mut raw).map_err(|e| Error::io("read a frame", &self.path, e))?;
        let value = |b: &[u8]| self.sample.decode(b) / self.white;
        let data: Vec<f32> = if self.channels == 1 {
            raw.chunks_exact(bytes).map(|b| self.transfer.decode(value(b))).collect()
        } else {
            raw.chunks_exact(3 * bytes)
                .map(|p| [value(&p[..bytes]), value(&p[bytes..2 * bytes]), value(&p[2 * bytes..])])
                .map(|rgb| self.transfer.gray(rgb))
                .collect()
        };
        check_values(&data, &self.path)?;
        Ok(Some(Frame { size: self.size, data }))
    }
}
