//! YUV4MPEG2, the plain video format of pipes; only luma is used.

use super::FrameReader;
use qudi_core::Transfer;
use qudi_core::limits::VIDEO_FRAME_BYTES;
use qudi_core::{Frame, Size};
use qudi_core::{Result, SimError};
use std::cell::Cell;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// Counts the bytes that the decoder takes: it reports a cut-off frame as a plain end.
struct Counted<R> {
    inner: R,
    bytes: Rc<Cell<u64>>,
}

impl<R: Read> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let n = self.inner.read(buffer)?;
        self.bytes.set(self.bytes.get() + n as u64);
        Ok(n)
    }
}

pub(super) struct Y4m<R: Read> {
    decoder: y4m::Decoder<Counted<R>>,
    bytes: Rc<Cell<u64>>,
    frame_end: u64,
    size: Size,
    path: PathBuf,
    transfer: Transfer,
    /// Luma of black and the span to white.
    black: f32,
    span: f32,
}

impl<R: Read> Y4m<R> {
    pub(super) fn open(reader: R, path: &Path, transfer: Transfer) -> Result<Self> {
        let bytes = Rc::new(Cell::new(0));
        let reader = Counted { inner: reader, bytes: Rc::clone(&bytes) };
        let limits = y4m::Limits { bytes: VIDEO_FRAME_BYTES };
        let decoder =
            y4m::Decoder::new_with_limits(reader, limits).map_err(|e| damaged(path, &e))?;
        let size =
            Size::new(decoder.get_height(), decoder.get_width(), &path.display().to_string())?;
        let unit = f32::from(1u16 << (decoder.get_bit_depth().clamp(8, 16) - 8));
        let full = contains(decoder.get_raw_params(), b"XCOLORRANGE=FULL");
        // Video luma runs from 16 to 235 unless the stream says otherwise.
        let (black, span) =
            if full { (0.0, 256.0 * unit - 1.0) } else { (16.0 * unit, 219.0 * unit) };
        let frame_end = bytes.get();
        Ok(Self { decoder, bytes, frame_end, size, path: path.to_owned(), transfer, black, span })
    }
}

fn contains(text: &[u8], word: &[u8]) -> bool {
    text.windows(word.len()).any(|part| part == word)
}

fn damaged(path: &Path, e: &y4m::Error) -> SimError {
    let what = match e {
        y4m::Error::EOF => "the stream is empty or ends inside a frame".to_owned(),
        y4m::Error::OutOfMemory => format!("a frame of more than {VIDEO_FRAME_BYTES} bytes"),
        y4m::Error::IoError(e) => format!("cannot read the stream: {e}"),
        other => format!("not a readable Y4M stream: {other}"),
    };
    SimError::data(what, path, "make one with `ffmpeg -i VIDEO -f yuv4mpegpipe -`")
}

impl<R: Read> FrameReader for Y4m<R> {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        None
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        let bytes = self.decoder.get_bytes_per_sample();
        let frame = match self.decoder.read_frame() {
            Ok(frame) => frame,
            Err(y4m::Error::EOF) if self.bytes.get() == self.frame_end => return Ok(None),
            Err(e) => return Err(damaged(&self.path, &e)),
        };
        self.frame_end = self.bytes.get();
        let value = |luma: u16| {
            let value = ((f32::from(luma) - self.black) / self.span).clamp(0.0, 1.0);
            self.transfer.decode(value)
        };
        let luma = frame.get_y_plane();
        let data: Vec<f32> = if bytes == 1 {
            luma.iter().map(|&v| value(u16::from(v))).collect()
        } else {
            luma.chunks_exact(2).map(|b| value(u16::from_le_bytes([b[0], b[1]]))).collect()
        };
        Ok(Some(Frame { size: self.size, data }))
    }
}
