//! YUV4MPEG2, the plain video format of pipes; only luma is used.

use super::FrameReader;
use qudi_core::Transfer;
use qudi_core::limits::VIDEO_FRAME_BYTES;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::cell::Cell;
use std::io::{Chain, Cursor, Read};
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// Bytes of the longest first line that the decoder reads.
const HEADER_BYTES: usize = 1024;

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
    decoder: y4m::Decoder<Counted<Chain<Cursor<Vec<u8>>, R>>>,
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
    pub(super) fn open(mut reader: R, path: &Path, transfer: Transfer) -> Result<Self> {
        let line = first_line(&mut reader).map_err(|e| Error::io("read the stream", path, e))?;
        let (line, bits) = with_known_layout(&line, path)?;
        let bytes = Rc::new(Cell::new(0));
        let inner = Cursor::new(line).chain(reader);
        let reader = Counted { inner, bytes: Rc::clone(&bytes) };
        let limits = y4m::Limits { bytes: VIDEO_FRAME_BYTES };
        let decoder =
            y4m::Decoder::new_with_limits(reader, limits).map_err(|e| damaged(path, &e))?;
        let size =
            Size::new(decoder.get_height(), decoder.get_width(), &path.display().to_string())?;
        let unit = f32::from(1u16 << (bits - 8));
        let full = contains(decoder.get_raw_params(), b"XCOLORRANGE=FULL");
        // Video luma runs from 16 to 235 unless the stream says otherwise.
        let (black, span) =
            if full { (0.0, 256.0 * unit - 1.0) } else { (16.0 * unit, 219.0 * unit) };
        let frame_end = bytes.get();
        Ok(Self { decoder, bytes, frame_end, size, path: path.to_owned(), transfer, black, span })
    }
}

/// Reads the first line of a stream with its end, or as much as a header can hold.
fn first_line(reader: &mut impl Read) -> std::io::Result<Vec<u8>> {
    let mut line = Vec::new();
    let mut byte = [0];
    while line.len() < HEADER_BYTES && !line.ends_with(b"\n") && reader.read(&mut byte)? > 0 {
        line.push(byte[0]);
    }
    Ok(line)
}

/// Returns the header with a colour space that the decoder knows, and the bits of a sample.
///
/// ffmpeg writes more depths than the decoder has names for; all depths above 8 bits have the layout of 12.
fn with_known_layout(line: &[u8], path: &Path) -> Result<(Vec<u8>, u32)> {
    let words = || line.trim_ascii_end().split(|&byte| byte == b' ').skip(1);
    let Some(name) = words().find_map(|word| word.strip_prefix(b"C")) else {
        return Ok((line.to_vec(), 8));
    };
    let name = String::from_utf8_lossy(name).into_owned();
    if ["mono", "420", "422", "444", "420jpeg", "420paldv", "420mpeg2"].contains(&name.as_str()) {
        return Ok((line.to_vec(), 8));
    }
    for family in ["mono", "420p", "422p", "444p"] {
        let bits = name.strip_prefix(family).and_then(|bits| bits.parse().ok());
        if let Some(bits @ 9..=16) = bits {
            let line = String::from_utf8_lossy(line);
            let known = line.replacen(&format!(" C{name}"), &format!(" C{family}12"), 1);
            return Ok((known.into_bytes(), bits));
        }
    }
    Err(Error::data(
        format!("a Y4M stream in the colour space `{name}`, which is not supported"),
        path,
        "convert it with `ffmpeg -i VIDEO -pix_fmt yuv444p -f yuv4mpegpipe -`",
    ))
}

fn contains(text: &[u8], word: &[u8]) -> bool {
    text.windows(word.len()).any(|part| part == word)
}

fn damaged(path: &Path, e: &y4m::Error) -> Error {
    let what = match e {
        y4m::Error::EOF => "the stream is empty or ends inside a frame".to_owned(),
        y4m::Error::OutOfMemory => format!("a frame of more than {VIDEO_FRAME_BYTES} bytes"),
        y4m::Error::IoError(e) => format!("cannot read the stream: {e}"),
        other => format!("not a readable Y4M stream: {other}"),
    };
    Error::data(what, path, "make one with `ffmpeg -i VIDEO -f yuv4mpegpipe -`")
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Decodes the first frame of a stream of 2 x 1 pixels in a colour space, with these bytes.
    fn first(parameters: &str, bytes: &[u8]) -> Result<Vec<f32>> {
        let header = format!("YUV4MPEG2 W2 H1 F25:1 {parameters}\nFRAME\n");
        let stream = [header.as_bytes(), bytes].concat();
        let mut clip = Y4m::open(stream.as_slice(), Path::new("x.y4m"), Transfer::AsIs)?;
        let frame = clip.next()?.map(|frame| frame.data).unwrap_or_default();
        assert!(clip.next()?.is_none());
        Ok(frame)
    }

    #[test]
    fn reads_every_depth_that_ffmpeg_writes() {
        for bits in [10u8, 12, 14, 16] {
            let (black, white) = (16u16 << (bits - 8), 235u16 << (bits - 8));
            let luma = [black.to_le_bytes(), white.to_le_bytes()].concat();
            let chroma = [0; 8];
            let gray = first(&format!("Cmono{bits}"), &luma).unwrap();
            let colour = first(&format!("C444p{bits}"), &[&luma[..], &chroma].concat()).unwrap();
            assert_eq!((gray, colour), (vec![0.0, 1.0], vec![0.0, 1.0]), "{bits} bits");
        }
    }

    #[test]
    fn reads_the_full_range_where_it_is_said() {
        let full = first("Cmono XCOLORRANGE=FULL", &[0, 255]).unwrap();
        assert_eq!(full, [0.0, 1.0]);
        assert_eq!(first("Cmono", &[16, 235]).unwrap(), [0.0, 1.0]);
        assert_eq!(first("Cmono16 XCOLORRANGE=FULL", &[0, 0, 255, 255]).unwrap(), [0.0, 1.0]);
    }

    #[test]
    fn names_a_colour_space_that_it_cannot_read() {
        let error = first("C411", &[0; 4]).unwrap_err().to_string();
        assert!(error.contains("the colour space `411`"), "{error}");
    }
}
