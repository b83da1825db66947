//! A stream of binary PPM images, one after another, as ffmpeg writes them into a pipe.

use super::FrameReader;
use image::codecs::pnm::PnmDecoder;
use image::{ColorType, ImageDecoder};
use qudi_core::{Error, Frame, Result, Size, Transfer};
use std::io::BufRead;
use std::path::{Path, PathBuf};

/// Frames of a PPM stream, converted to gray.
pub(super) struct PpmStream<R: BufRead> {
    reader: R,
    /// The next frame, already decoded.
    next: Option<Frame>,
    size: Size,
    path: PathBuf,
    transfer: Transfer,
}

impl<R: BufRead> PpmStream<R> {
    /// Reads the first frame; none for an empty stream.
    pub(super) fn open(mut reader: R, path: &Path, transfer: Transfer) -> Result<Option<Self>> {
        let Some(first) = read_frame(&mut reader, path, transfer)? else { return Ok(None) };
        let size = first.size;
        Ok(Some(Self { reader, next: Some(first), size, path: path.to_owned(), transfer }))
    }
}

fn damaged(path: &Path, what: &str) -> Error {
    Error::data(
        format!("the decoded video is broken: {what}"),
        path,
        "check the file with `ffmpeg -i FILE -f null -`",
    )
}

/// Decodes one image; none at the end of the stream.
fn read_frame(reader: &mut impl BufRead, path: &Path, transfer: Transfer) -> Result<Option<Frame>> {
    let rest = reader.fill_buf().map_err(|e| Error::io("read the decoded video", path, e))?;
    if rest.is_empty() {
        return Ok(None);
    }
    let broken = |e: image::ImageError| match &e {
        image::ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            damaged(path, "it ends inside a frame")
        }
        _ => damaged(path, &e.to_string()),
    };
    let decoder = PnmDecoder::new(reader).map_err(broken)?;
    if decoder.color_type() != ColorType::Rgb8 {
        return Err(damaged(path, "it is not 8-bit RGB"));
    }
    let (width, height) = decoder.dimensions();
    // Refuses sizes beyond the limit on pixels before anything is allocated.
    let size = Size::new(height as usize, width as usize, &path.display().to_string())?;
    let mut bytes = vec![0; 3 * size.pixels()];
    decoder.read_image(&mut bytes).map_err(broken)?;
    let gray = |p: &[u8]| transfer.gray([p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0)).min(1.0);
    Ok(Some(Frame { size, data: bytes.chunks_exact(3).map(gray).collect() }))
}

impl<R: BufRead> FrameReader for PpmStream<R> {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        None
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if let Some(frame) = self.next.take() {
            return Ok(Some(frame));
        }
        match read_frame(&mut self.reader, &self.path, self.transfer)? {
            Some(frame) if frame.size != self.size => {
                Err(damaged(&self.path, "its frames change size"))
            }
            frame => Ok(frame),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn random_streams_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), magic: bool) {
            let start: &[u8] = if magic { b"P6\n2 2\n255\n" } else { b"" };
            let bytes = [start, &bytes].concat();
            if let Ok(Some(mut stream)) = open(&bytes) {
                while let Ok(Some(_)) = stream.next() {}
            }
        }
    }

    fn open(bytes: &[u8]) -> Result<Option<PpmStream<&[u8]>>> {
        PpmStream::open(bytes, Path::new("x.mp4"), Transfer::AsIs)
    }

    #[test]
    fn reads_frames_one_after_another() {
        let mut bytes = b"P6\n2 1\n255\n".to_vec();
        bytes.extend([255, 255, 255, 0, 0, 0]);
        bytes.extend(b"P6\n2 1\n255\n\x80\x80\x80\xff\x00\x00");
        let mut stream = open(&bytes).unwrap().unwrap();
        assert_eq!(stream.next().unwrap().unwrap().data, [1.0, 0.0]);
        let second = stream.next().unwrap().unwrap();
        assert!((second.data[1] - 0.299).abs() < 1e-6);
        assert!(stream.next().unwrap().is_none());
    }

    #[test]
    fn rejects_broken_streams() {
        assert!(open(b"").unwrap().is_none());
        assert!(open(b"P5\n2 1\n255\n12").is_err());
        assert!(open(b"P6 99999999999999999999").is_err());
        assert!(open(b"P6\n100000 100000\n255\n").is_err());
        assert!(open(b"P6\n1000 1000\n255\nabc").is_err());
    }
}
