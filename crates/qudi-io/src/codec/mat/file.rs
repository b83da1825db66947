//! Headers of MATLAB files of level 5 (`save -v6`, `-v7`), which give the place of their arrays.
//!
//! MAT-File Level 5 File Format, The MathWorks, 1999: a 128-byte header, then elements of a tag
//! (type, bytes) and data; `miMATRIX` holds flags, dimensions, name and samples, and may be
//! compressed whole.

use crate::frames::frame_bytes::Opener;
use flate2::read::ZlibDecoder;
use qudi_core::limits::{ARRAY_HEADER_BYTES, DEFLATE_RATIO, MAT_VARIABLES};
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;

/// A numeric array in a `.mat` file.
#[derive(Clone, Debug)]
pub(crate) struct MatArray {
    pub(crate) name: String,
    /// Extents, the first axis being the fastest.
    pub(crate) dims: Vec<usize>,
    pub(crate) sample: Sample,
    /// Byte of the element in the file, and its length there.
    element: (u64, u64),
    compressed: bool,
    /// Byte of the samples within the (decompressed) element.
    data: u64,
    /// Bytes of samples.
    bytes: u64,
}

impl MatArray {
    /// Returns the byte where the samples start and their number of bytes, if they are not compressed.
    pub(crate) fn in_place(&self) -> Option<(u64, u64)> {
        (!self.compressed).then_some((self.element.0 + self.data, self.bytes))
    }

    /// Refuses an array that its bytes in the file cannot hold, however well compressed.
    pub(crate) fn refuse_bomb(&self, path: &Path) -> Result<()> {
        if self.bytes <= self.element.1.saturating_mul(DEFLATE_RATIO) {
            return Ok(());
        }
        Err(damaged(
            format!("`{}` promises more than its compressed bytes can hold", self.name),
            path,
        ))
    }

    /// Opens the samples of a compressed array.
    pub(crate) fn opener(&self, path: &Path) -> Opener {
        let (path, array) = (path.to_owned(), self.clone());
        Box::new(move || {
            let mut stream = stream(&path, array.element, array.compressed)?;
            skip(&mut stream, array.data, &path)?;
            Ok(Box::new(stream))
        })
    }
}

fn stream(
    path: &Path,
    (start, length): (u64, u64),
    compressed: bool,
) -> Result<Box<dyn Read + Send>> {
    let io = |e| Error::io("open", path, e);
    let mut file = File::open(path).map_err(io)?;
    file.seek(SeekFrom::Start(start)).map_err(io)?;
    let stored = BufReader::with_capacity(1 << 16, file.take(length));
    Ok(if compressed { Box::new(ZlibDecoder::new(stored)) } else { Box::new(stored) })
}

fn damaged(what: impl Into<String>, path: &Path) -> Error {
    Error::data(what, path, "save it again from MATLAB with `save -v7`")
}

fn skip(stream: &mut impl Read, bytes: u64, path: &Path) -> Result<()> {
    let skipped = std::io::copy(&mut stream.take(bytes), &mut std::io::sink())
        .map_err(|e| damaged(format!("the compressed data are damaged: {e}"), path))?;
    if skipped == bytes { Ok(()) } else { Err(damaged("an array ends inside its header", path)) }
}

/// Returns true if these are the first bytes of a level-5 file.
pub(crate) fn is_level_5(head: &[u8]) -> bool {
    head.len() >= 128 && matches!(&head[124..128], [0, 1, b'I', b'M'] | [1, 0, b'M', b'I'])
}

/// Lists the numeric arrays of a file.
pub(crate) fn arrays(path: &Path) -> Result<Vec<MatArray>> {
    let io = |e| Error::io("read", path, e);
    let mut file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut head = [0u8; 128];
    file.read_exact(&mut head).map_err(|_| damaged("the file ends inside its header", path))?;
    if !is_level_5(&head) {
        return Err(damaged("not a level-5 .mat file", path));
    }
    let big = head[126] == b'M';
    let mut found = Vec::new();
    let mut at = 128u64;
    while at + 8 <= length {
        if found.len() >= MAT_VARIABLES {
            return Err(damaged(format!("more than {MAT_VARIABLES} variables"), path));
        }
        let mut tag = [0u8; 8];
        file.seek(SeekFrom::Start(at)).and_then(|_| file.read_exact(&mut tag)).map_err(io)?;
        let (kind, bytes) = (word(&tag[..4], big), u64::from(word(&tag[4..], big)));
        let start = at + 8;
        if start + bytes > length {
            return Err(damaged(
                format!(
                    "a variable of {bytes} bytes at byte {at}, beyond the end of the file ({length})"
                ),
                path,
            ));
        }
        let element = match kind {
            MATRIX | COMPRESSED => Some((start, bytes)),
            _ => None,
        };
        if let Some(element) = element {
            let compressed = kind == COMPRESSED;
            let mut stream = stream(path, element, compressed)?;
            let mut reader = Elements { stream: &mut stream, at: 0, big, path };
            if let Some(array) = reader.matrix(element, compressed)? {
                found.push(array);
            }
        }
        at = start + bytes;
        if kind != COMPRESSED {
            at = at.next_multiple_of(8);
        }
    }
    Ok(found)
}

fn word(bytes: &[u8], big: bool) -> u32 {
    let four = [bytes[0], bytes[1], bytes[2], bytes[3]];
    if big { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) }
}

struct Elements<'a> {
    stream: &'a mut dyn Read,
    /// Bytes read so far.
    at: u64,
    big: bool,
    path: &'a Path,
}

impl Elements<'_> {
    fn take(&mut self, bytes: usize) -> Result<Vec<u8>> {
        let mut taken = vec![0u8; bytes];
        self.stream
            .read_exact(&mut taken)
            .map_err(|e| damaged(format!("a variable is damaged: {e}"), self.path))?;
        self.at += bytes as u64;
        Ok(taken)
    }

    /// Reads the type and length of the next element, and its data if they fit into the tag.
    fn tag(&mut self) -> Result<(u32, u64, Option<Vec<u8>>)> {
        let tag = self.take(8)?;
        let first = word(&tag[..4], self.big);
        let (small, kind) = (first >> 16, first & 0xffff);
        if small == 0 {
            return Ok((kind, u64::from(word(&tag[4..], self.big)), None));
        }
        let data = tag[4..].get(..small as usize);
        let data =
            data.ok_or_else(|| damaged("a small element of more than 4 bytes", self.path))?;
        Ok((kind, u64::from(small), Some(data.to_vec())))
    }

    /// Reads a short element whole, with its padding.
    fn short(&mut self) -> Result<(u32, Vec<u8>)> {
        let (kind, bytes, data) = self.tag()?;
        if let Some(data) = data {
            return Ok((kind, data));
        }
        if bytes > ARRAY_HEADER_BYTES as u64 {
            return Err(damaged(format!("a header element of {bytes} bytes"), self.path));
        }
        let mut data = self.take((bytes as usize).next_multiple_of(8))?;
        data.truncate(bytes as usize);
        Ok((kind, data))
    }

    /// Reads the array in a matrix element; `None` for text, structures and the like.
    fn matrix(&mut self, element: (u64, u64), compressed: bool) -> Result<Option<MatArray>> {
        if compressed {
            let (kind, ..) = self.tag()?;
            if kind != MATRIX {
                return Ok(None);
            }
        }
        let (_, flags) = self.short()?;
        if flags.len() < 8 {
            return Err(damaged("an array without flags", self.path));
        }
        let flags = word(&flags, self.big);
        let (class, complex) = (flags & 0xff, flags & 0x800 != 0);
        let (_, dims) = self.short()?;
        let (_, name) = self.short()?;
        if !(6..=15).contains(&class) || complex {
            return Ok(None);
        }
        let (kind, bytes, small) = self.tag()?;
        let Some(sample) = sample(kind, self.big) else { return Ok(None) };
        let dims: Vec<usize> = dims.chunks_exact(4).map(|d| word(d, self.big) as usize).collect();
        let samples = dims.iter().try_fold(1u64, |n, &d| n.checked_mul(d as u64));
        let promised = samples.and_then(|n| n.checked_mul(sample.bytes() as u64));
        let name = String::from_utf8_lossy(&name).into_owned();
        if promised != Some(bytes) {
            return Err(damaged(
                format!("array `{name}` of {dims:?} holds {bytes} bytes"),
                self.path,
            ));
        }
        let data = if small.is_some() { self.at - 4 } else { self.at };
        if !compressed && data + bytes > element.1 {
            return Err(damaged(format!("array `{name}` is longer than its element"), self.path));
        }
        Ok(Some(MatArray { name, dims, sample, element, compressed, data, bytes }))
    }
}

/// Returns the sample type of a data element; stored types may be narrower than the array's class.
fn sample(kind: u32, big_endian: bool) -> Option<Sample> {
    let integer = |bytes, signed| Some(Sample::Integer { bytes, signed, big_endian });
    match kind {
        1 => integer(1, true),
        2 => Some(Sample::U8),
        3 => integer(2, true),
        4 => Some(Sample::U16 { big_endian }),
        5 => integer(4, true),
        6 => integer(4, false),
        7 => Some(Sample::F32 { big_endian }),
        9 => Some(Sample::F64 { big_endian }),
        12 => integer(8, true),
        13 => integer(8, false),
        _ => None,
    }
}

/// Reads a two-dimensional array, row-major: a map of the pixels.
pub(crate) fn read_map(array: &MatArray, path: &Path) -> Result<qudi_core::Frame> {
    let &[height, width] = array.dims.as_slice() else {
        return Err(damaged(format!("`{}` has extents {:?}", array.name, array.dims), path));
    };
    let size = qudi_core::Size::new(height, width, &path.display().to_string())?;
    array.refuse_bomb(path)?;
    let mut bytes = vec![0u8; array.bytes as usize];
    array.opener(path)()?
        .read_exact(&mut bytes)
        .map_err(|e| damaged(format!("`{}` is damaged: {e}", array.name), path))?;
    let value = |x: usize, y: usize| {
        let at = (x * height + y) * array.sample.bytes();
        array.sample.decode(&bytes[at..at + array.sample.bytes()])
    };
    Ok(qudi_core::Frame::from_fn(size, value))
}
