//! A stream of binary PPM images (P6, 8 bits), as ffmpeg writes them into a pipe.

use super::FrameReader;
use qudi_core::Transfer;
use qudi_core::{Frame, Size};
use qudi_core::{Result, SimError};
use std::io::{BufRead, ErrorKind, Read};
use std::path::{Path, PathBuf};

pub(super) struct PpmStream<R: BufRead> {
    reader: R,
    size: Size,
    /// The first header has been read already.
    pending: bool,
    path: PathBuf,
    transfer: Transfer,
}

impl<R: BufRead> PpmStream<R> {
    /// None for an empty stream.
    pub(super) fn open(mut reader: R, path: &Path, transfer: Transfer) -> Result<Option<Self>> {
        let Some(size) = read_header(&mut reader, path)? else { return Ok(None) };
        Ok(Some(Self { reader, size, pending: true, path: path.to_owned(), transfer }))
    }
}

fn damaged(path: &Path, what: &str) -> SimError {
    SimError::data(
        format!("the decoded video is broken: {what}"),
        path,
        "check the file with `ffmpeg -i FILE -f null -`",
    )
}

/// The size in the next header; none at the end of the stream.
fn read_header(reader: &mut impl BufRead, path: &Path) -> Result<Option<Size>> {
    let mut words: Vec<String> = Vec::new();
    let mut word = String::new();
    while words.len() < 4 {
        let mut byte = [0u8];
        match reader.read_exact(&mut byte) {
            Err(e)
                if e.kind() == ErrorKind::UnexpectedEof && words.is_empty() && word.is_empty() =>
            {
                return Ok(None);
            }
            Err(e) => return Err(SimError::io("read the decoded video", path, e)),
            Ok(()) if !byte[0].is_ascii_whitespace() => word.push(byte[0] as char),
            Ok(()) => words.push(std::mem::take(&mut word)),
        }
        if word.len() > 16 {
            return Err(damaged(path, "no PPM header"));
        }
    }
    let number = |i: usize| words[i].parse::<usize>().map_err(|_| damaged(path, "no PPM header"));
    if words[0] != "P6" || words[3] != "255" {
        return Err(damaged(path, "no 8-bit PPM header"));
    }
    Size::new(number(2)?, number(1)?, &path.display().to_string()).map(Some)
}

impl<R: BufRead> FrameReader for PpmStream<R> {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        None
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if !std::mem::take(&mut self.pending) {
            match read_header(&mut self.reader, &self.path)? {
                None => return Ok(None),
                Some(size) if size != self.size => {
                    return Err(damaged(&self.path, "its frames change size"));
                }
                Some(_) => {}
            }
        }
        // Read through `take`, so that a lying header allocates no more than what arrives.
        let bytes = 3 * self.size.pixels();
        let mut raw = Vec::new();
        let read = (&mut self.reader).take(bytes as u64).read_to_end(&mut raw);
        read.map_err(|e| SimError::io("read the decoded video", &self.path, e))?;
        if raw.len() < bytes {
            return Err(damaged(&self.path, "it ends inside a frame"));
        }
        let data = raw
            .chunks_exact(3)
            .map(|p| self.transfer.gray([p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0)).min(1.0));
        Ok(Some(Frame { size: self.size, data: data.collect() }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn no_stream_panics(bytes in prop::collection::vec(any::<u8>(), 0..200), magic: bool) {
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
    fn two_frames_are_two_frames() {
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
    fn broken_streams_are_errors() {
        assert!(open(b"").unwrap().is_none());
        assert!(open(b"P5\n2 1\n255\n").is_err());
        assert!(open(b"P6 99999999999999999999").is_err());
        assert!(open(b"P6\n100000 100000\n255\n").is_err());
        let mut short = open(b"P6\n1000 1000\n255\nabc").unwrap().unwrap();
        assert!(short.next().is_err());
    }
}
