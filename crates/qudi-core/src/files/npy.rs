//! NumPy `.npy` files: a strict header reader and a streaming writer.
//!
//! Nothing is allocated from a header before the sizes it claims are checked against the file.

mod half;

use crate::error::{Error, Result};
use crate::frame::{Frame, Size};
use crate::limits::{ARRAY_HEADER_BYTES, HELD_ARRAY_BYTES};
use crate::regular_file::open_regular;
use half::half;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Write};
use std::path::Path;

/// Sample types that images and counts come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sample {
    /// `|b1`
    Bool,
    /// `|u1`
    U8,
    /// `<u2` or `>u2`
    U16 {
        /// Most significant byte first.
        big_endian: bool,
    },
    /// `|i1`, and two, four and eight bytes signed or unsigned
    Integer {
        /// 1, 2, 4 or 8.
        bytes: u8,
        /// Two's complement.
        signed: bool,
        /// Most significant byte first.
        big_endian: bool,
    },
    /// `<f2` or `>f2`
    F16 {
        /// Most significant byte first.
        big_endian: bool,
    },
    /// `<f4` or `>f4`
    F32 {
        /// Most significant byte first.
        big_endian: bool,
    },
    /// `<f8` or `>f8`
    F64 {
        /// Most significant byte first.
        big_endian: bool,
    },
}

impl Sample {
    /// Returns the number of bytes per sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::U8 => 1,
            Self::U16 { .. } | Self::F16 { .. } => 2,
            Self::Integer { bytes, .. } => usize::from(bytes),
            Self::F32 { .. } => 4,
            Self::F64 { .. } => 8,
        }
    }

    fn from_descr(descr: &str) -> Option<Self> {
        let big_endian = descr.starts_with('>');
        Some(match descr.trim_start_matches(['<', '>', '|', '=']) {
            "b1" => Self::Bool,
            "u1" => Self::U8,
            "u2" => Self::U16 { big_endian },
            "f2" => Self::F16 { big_endian },
            "f4" => Self::F32 { big_endian },
            "f8" => Self::F64 { big_endian },
            "i1" => Self::Integer { bytes: 1, signed: true, big_endian },
            "i2" => Self::Integer { bytes: 2, signed: true, big_endian },
            "i4" => Self::Integer { bytes: 4, signed: true, big_endian },
            "i8" => Self::Integer { bytes: 8, signed: true, big_endian },
            "u4" => Self::Integer { bytes: 4, signed: false, big_endian },
            "u8" => Self::Integer { bytes: 8, signed: false, big_endian },
            _ => return None,
        })
    }

    /// Returns the value of full scale, 1 for booleans and floats; wide integers have none.
    pub fn full_scale(self) -> Option<f32> {
        match self {
            Self::U8 => Some(255.0),
            Self::U16 { .. } => Some(65535.0),
            Self::Integer { .. } => None,
            _ => Some(1.0),
        }
    }

    fn big_endian(self) -> bool {
        match self {
            Self::Bool | Self::U8 => false,
            Self::U16 { big_endian }
            | Self::F16 { big_endian }
            | Self::F32 { big_endian }
            | Self::F64 { big_endian }
            | Self::Integer { big_endian, .. } => big_endian,
        }
    }

    /// Decodes the sample in `bytes`, which holds exactly one.
    pub fn decode(self, bytes: &[u8]) -> f32 {
        let mut word = [0u8; 8];
        word[..bytes.len()].copy_from_slice(bytes);
        if self.big_endian() {
            word[..bytes.len()].reverse();
        }
        let four = [word[0], word[1], word[2], word[3]];
        match self {
            Self::Bool => f32::from(word[0] != 0),
            Self::U8 => f32::from(word[0]),
            Self::U16 { .. } => f32::from(u16::from_le_bytes([word[0], word[1]])),
            Self::Integer { bytes, signed, .. } => {
                let word = u64::from_le_bytes(word);
                let unused = 64 - 8 * u32::from(bytes);
                if signed { (((word << unused) as i64) >> unused) as f32 } else { word as f32 }
            }
            Self::F16 { .. } => half(u16::from_le_bytes([word[0], word[1]])),
            Self::F32 { .. } => f32::from_le_bytes(four),
            Self::F64 { .. } => f64::from_le_bytes(word) as f32,
        }
    }
}

/// Header of a `.npy` file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Sample type.
    pub sample: Sample,
    /// Extent of each axis, as NumPy prints it.
    pub shape: Vec<usize>,
    /// Whether the *first* axis is the fastest in memory.
    pub fortran: bool,
    /// Bytes before the data.
    pub data_start: u64,
}

impl Header {
    /// Reads a header from `reader`; `path` is for messages.
    ///
    /// # Errors
    /// [`Error::Data`] if it is no `.npy` of a supported type.
    pub fn read(reader: &mut impl Read, path: &Path) -> Result<Self> {
        let fault = |what: &str| {
            Error::data(
                what,
                path,
                "write it with numpy.save, as booleans, integers, float32 or float64",
            )
        };
        let ended = |e: std::io::Error| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => fault("the file ends inside its .npy header"),
            _ => Error::io("read the .npy header", path, e),
        };
        let mut start = [0u8; 10];
        reader.read_exact(&mut start).map_err(ended)?;
        if &start[..6] != b"\x93NUMPY" {
            return Err(fault("not a .npy file"));
        }
        let (length, prefix) = match start[6] {
            1 => (usize::from(u16::from_le_bytes([start[8], start[9]])), 10),
            2 | 3 => {
                let mut rest = [0u8; 2];
                reader.read_exact(&mut rest).map_err(ended)?;
                (u32::from_le_bytes([start[8], start[9], rest[0], rest[1]]) as usize, 12)
            }
            version => return Err(fault(&format!("a .npy file of unknown version {version}"))),
        };
        if length > ARRAY_HEADER_BYTES {
            return Err(fault(&format!("a .npy header of {length} bytes")));
        }
        let mut text = vec![0u8; length];
        reader.read_exact(&mut text).map_err(ended)?;
        let text = String::from_utf8(text).map_err(|_| fault("the .npy header is not text"))?;
        let (descr, fortran, shape) = parse_dictionary(&text).ok_or_else(|| {
            if text.contains("[(") {
                return fault("records of several fields, as of events (x, y, t), and no frames");
            }
            fault("the .npy header is malformed")
        })?;
        let sample = Sample::from_descr(&descr)
            .ok_or_else(|| fault(&format!("samples of type `{descr}` are not images or counts")))?;
        let fortran = fortran && shape.len() > 1;
        Ok(Self { sample, shape, fortran, data_start: (prefix + length) as u64 })
    }

    /// Returns the data that follow this header in `reader`, the last axis the fastest. An array in Fortran
    /// order is read whole.
    ///
    /// # Errors
    /// [`Error`] if an array in Fortran order cannot be read, or is too large to be held.
    pub fn in_c_order(&self, reader: impl Read + 'static, path: &Path) -> Result<Box<dyn Read>> {
        if !self.fortran {
            return Ok(Box::new(reader));
        }
        let bytes = self.data_bytes().unwrap_or(u64::MAX);
        if bytes > HELD_ARRAY_BYTES {
            return Err(Error::data(
                format!(
                    "an array of {bytes} bytes in Fortran order, which is read whole; at most {HELD_ARRAY_BYTES} are"
                ),
                path,
                "save it as numpy.save(NAME, numpy.ascontiguousarray(array))",
            ));
        }
        let mut data = Vec::new();
        reader
            .take(bytes)
            .read_to_end(&mut data)
            .map_err(|e| Error::io("read the array", path, e))?;
        if data.len() as u64 != bytes {
            return Err(Error::data("the array ends early", path, "copy or export it again"));
        }
        Ok(Box::new(Cursor::new(self.transposed(&data))))
    }

    /// Transposes data in Fortran order, so that the last axis is the fastest.
    fn transposed(&self, data: &[u8]) -> Vec<u8> {
        let length = self.sample.bytes();
        let stride = |axis: usize| self.shape[..axis].iter().product::<usize>();
        let strides: Vec<usize> = (0..self.shape.len()).map(stride).collect();
        let mut at = vec![0; self.shape.len()];
        let mut turned = Vec::with_capacity(data.len());
        while turned.len() < data.len() {
            let place: usize = at.iter().zip(&strides).map(|(at, stride)| at * stride).sum();
            turned.extend_from_slice(&data[place * length..][..length]);
            for (at, &extent) in at.iter_mut().zip(&self.shape).rev() {
                *at += 1;
                if *at < extent {
                    break;
                }
                *at = 0;
            }
        }
        turned
    }

    /// Returns the number of data bytes that the header promises, or `None` if it overflows.
    pub fn data_bytes(&self) -> Option<u64> {
        let samples = self.shape.iter().try_fold(1u64, |n, &d| n.checked_mul(d as u64))?;
        samples.checked_mul(self.sample.bytes() as u64)
    }

    /// Opens a file and checks that it holds all the data its header promises.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, is malformed, or is too short.
    pub fn open(path: &Path) -> Result<(Self, BufReader<File>)> {
        let io = |e| Error::io("open the file", path, e);
        let file = open_regular(path, "open the file")?;
        let length = file.metadata().map_err(io)?.len();
        let mut reader = BufReader::with_capacity(1 << 16, file);
        let header = Self::read(&mut reader, path)?;
        let there = length - header.data_start.min(length);
        match header.data_bytes() {
            Some(promised) if promised <= there => Ok((header, reader)),
            Some(promised) => Err(Error::data(
                format!(
                    "the file is truncated: its header promises {promised} bytes of data, it holds {there}"
                ),
                path,
                "copy or export it again",
            )),
            None => Err(Error::data(
                format!("its header claims an impossible shape, {:?}", header.shape),
                path,
                "the file is damaged: export it again",
            )),
        }
    }
}

/// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }`.
fn parse_dictionary(text: &str) -> Option<(String, bool, Vec<usize>)> {
    let after = |key: &str| {
        let at = text.find(&format!("'{key}'"))? + key.len() + 2;
        text[at..].trim_start().strip_prefix(':').map(str::trim_start)
    };
    let descr = after("descr")?.strip_prefix('\'')?;
    let descr = descr[..descr.find('\'')?].to_owned();
    let order = after("fortran_order")?;
    let fortran = order.starts_with("True");
    if !fortran && !order.starts_with("False") {
        return None;
    }
    let shape = after("shape")?.strip_prefix('(')?;
    let shape = shape[..shape.find(')')?]
        .split(',')
        .map(str::trim)
        .filter(|d| !d.is_empty())
        .map(|d| d.parse().ok())
        .collect::<Option<Vec<usize>>>()?;
    Some((descr, fortran, shape))
}

/// Writes a `.npy` header, version 1.0, padded to 64 bytes as NumPy does.
///
/// `descr` is NumPy's type string, as in `|u1`, `<u2`, `<f4`.
pub fn write_header(out: &mut impl Write, descr: &str, shape: &[usize]) -> std::io::Result<()> {
    let mut dims = String::new();
    for (i, d) in shape.iter().enumerate() {
        dims += &format!("{}{d}", if i > 0 { ", " } else { "" });
    }
    if shape.len() == 1 {
        dims.push(',');
    }
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({dims}), }}");
    let padding = (64 - (10 + text.len() + 1) % 64) % 64;
    text.push_str(&" ".repeat(padding));
    text.push('\n');
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&(text.len() as u16).to_le_bytes())?;
    out.write_all(text.as_bytes())
}

/// Reads a two-dimensional `.npy` in C or Fortran order, values as they are.
///
/// # Errors
/// [`Error`] if it cannot be read or has another number of dimensions.
pub fn read_image(path: &Path) -> Result<Frame> {
    let (header, mut reader) = Header::open(path)?;
    let &[height, width] = header.shape.as_slice() else {
        return Err(Error::data(
            format!("an array of shape {:?} where one image is expected", header.shape),
            path,
            "save an array of shape (height, width)",
        ));
    };
    let size = Size::new(height, width, &path.display().to_string())?;
    let mut bytes = vec![0u8; size.pixels() * header.sample.bytes()];
    reader.read_exact(&mut bytes).map_err(|e| Error::io("read the data", path, e))?;
    let length = header.sample.bytes();
    let value = |at: usize| header.sample.decode(&bytes[at * length..][..length]);
    // In Fortran order columns come one after the other.
    let place = |y: usize, x: usize| if header.fortran { x * height + y } else { y * width + x };
    let data = (0..size.pixels()).map(|i| value(place(i / width, i % width))).collect();
    Ok(Frame { size, data })
}

/// Reads up to `max_frames` frames of a three-dimensional `.npy`: floats as they are, which may lie
/// outside [0, 1]; bytes and words relative to full scale.
///
/// # Errors
/// [`Error`] if it cannot be read, has other axes, or holds values that are not finite.
pub fn read_clip(path: &Path, max_frames: usize) -> Result<Vec<Frame>> {
    let (header, reader) = Header::open(path)?;
    // An axis of one channel, before or after the picture, holds nothing.
    let shape = match *header.shape.as_slice() {
        [frames, 1, height, width] | [frames, height, width, 1] | [frames, height, width] => {
            Some([frames, height, width])
        }
        [height, width] => Some([1, height, width]),
        _ => None,
    };
    let (Some([frames, height, width]), Some(full)) = (shape, header.sample.full_scale()) else {
        return Err(Error::data(
            format!(
                "an array of shape {:?}, or of wide integers, where a clip is expected",
                header.shape
            ),
            path,
            "save an array of shape (frames, height, width) as float32",
        ));
    };
    let size = Size::new(height, width, &path.display().to_string())?;
    let mut bytes = vec![0u8; size.pixels() * header.sample.bytes()];
    let mut clip = Vec::new();
    let mut reader = header.in_c_order(reader, path)?;
    for _ in 0..frames.min(max_frames) {
        reader.read_exact(&mut bytes).map_err(|e| Error::io("read a frame", path, e))?;
        let samples = bytes.chunks_exact(header.sample.bytes());
        let data: Vec<f32> = samples.map(|b| header.sample.decode(b) / full).collect();
        if let Some(bad) = data.iter().find(|v| !v.is_finite()) {
            return Err(Error::data(format!("a value of {bad}"), path, "replace missing values"));
        }
        clip.push(Frame { size, data });
    }
    Ok(clip)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Reading an arbitrary header returns a result and never panics.
        #[test]
        fn hostile_npy_headers_never_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..300), magic: bool) {
            if magic && bytes.len() > 8 {
                bytes[..8].copy_from_slice(b"\x93NUMPY\x01\x00");
            }
            let _ = Header::read(&mut bytes.as_slice(), Path::new("x.npy"));
        }

        #[test]
        fn hostile_npy_dictionaries_never_panic(text in "\\{('descr'|'shape'|'fortran_order'|[ ,:()'<f4u1|0-9]|True|False){0,20}") {
            let _ = parse_dictionary(&text);
        }
    }

    fn header_bytes(descr: &str, shape: &[usize]) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_header(&mut bytes, descr, shape).unwrap();
        bytes
    }

    #[test]
    fn npy_headers_are_aligned_and_read_back() {
        for shape in [vec![5], vec![3, 4], vec![100_000, 256, 64]] {
            let bytes = header_bytes("<u2", &shape);
            assert_eq!(bytes.len() % 64, 0);
            let header = Header::read(&mut bytes.as_slice(), Path::new("x.npy")).unwrap();
            assert_eq!(header.shape, shape);
            assert_eq!(header.sample, Sample::U16 { big_endian: false });
            assert_eq!(header.data_start, bytes.len() as u64);
        }
    }

    #[test]
    fn arrays_in_fortran_order_are_turned() {
        let shape = vec![2, 3, 4];
        let header = Header {
            sample: Sample::U16 { big_endian: false },
            shape,
            fortran: true,
            data_start: 0,
        };
        // Element (t, y, x) is 100 t + 10 y + x; t is the fastest.
        let value = |t: u16, y: u16, x: u16| 100 * t + 10 * y + x;
        let columns = (0..4).flat_map(|x| (0..3).flat_map(move |y| (0..2).map(move |t| (t, y, x))));
        let data: Vec<u8> = columns.flat_map(|(t, y, x)| value(t, y, x).to_le_bytes()).collect();
        let rows = (0..2).flat_map(|t| (0..3).flat_map(move |y| (0..4).map(move |x| (t, y, x))));
        let expected: Vec<u8> = rows.flat_map(|(t, y, x)| value(t, y, x).to_le_bytes()).collect();
        let path = Path::new("a.npy");
        let mut turned = Vec::new();
        let data = Cursor::new(data);
        header.in_c_order(data.clone(), path).unwrap().read_to_end(&mut turned).unwrap();
        assert_eq!(turned, expected);
        let short = Cursor::new(data.into_inner()[..47].to_vec());
        assert!(header.in_c_order(short, path).is_err());
        let huge = Header { shape: vec![1 << 20, 1 << 10, 4], ..header };
        assert!(huge.in_c_order(Cursor::new(vec![0]), path).is_err());
    }

    #[test]
    fn reads_headers_that_numpy_wrote() {
        let text = b"\x93NUMPY\x01\x00v\x00{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 4), }                                                          \n";
        let header = Header::read(&mut text.as_slice(), Path::new("x.npy")).unwrap();
        assert_eq!((header.sample, header.shape), (Sample::U8, vec![2, 3, 4]));
    }

    #[test]
    fn rejects_hostile_npy_headers() {
        let path = Path::new("x.npy");
        for bytes in [
            b"".to_vec(),
            b"\x93NUMPY".to_vec(),
            b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(),
            b"\x93NUMPY\x07\x00\x10\x00".to_vec(),
            b"\x93NUMPY\x01\x00\x03\x00abc".to_vec(),
            header_bytes("<c8", &[3]),
        ] {
            assert!(Header::read(&mut bytes.as_slice(), path).is_err(), "{bytes:?}");
        }
        let huge = Header {
            sample: Sample::U8,
            shape: vec![usize::MAX, 3],
            fortran: false,
            data_start: 0,
        };
        assert_eq!(huge.data_bytes(), None);
    }

    #[test]
    fn decodes_both_byte_orders() {
        assert_eq!(Sample::U16 { big_endian: true }.decode(&[1, 2]), 258.0);
        assert_eq!(Sample::U16 { big_endian: false }.decode(&[2, 1]), 258.0);
        assert_eq!(Sample::F32 { big_endian: true }.decode(&1.5f32.to_be_bytes()), 1.5);
        let signed = Sample::Integer { bytes: 2, signed: true, big_endian: true };
        assert_eq!(signed.decode(&(-2i16).to_be_bytes()), -2.0);
        let wide = Sample::Integer { bytes: 8, signed: true, big_endian: false };
        assert_eq!(wide.decode(&7i64.to_le_bytes()), 7.0);
        assert_eq!(Sample::F64 { big_endian: false }.decode(&2.25f64.to_le_bytes()), 2.25);
    }
}
