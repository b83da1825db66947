//! Captures from a pipe: NumPy arrays, which describe themselves, and raw frames by name.

use super::array::{Hints, Place};
use super::npy::array;
use super::raw::piped as piped_raw;
use crate::description::{CaptureInfo, ReadOptions, refuse_others};
use crate::frames::CountFrames;
use crate::frames::pipe::{Pipe, STDIN, Tail};
use qudi_core::npy::Header;
use qudi_core::{Error, Result};
use std::io::{Cursor, Read};
use std::path::Path;

/// Bytes that distinguish formats.
const MAGIC_BYTES: u64 = 16;

/// Streams that are piped by mistake: magic number, and the remedy.
const FOREIGN_STREAMS: &[(&[u8], &str, &str)] = &[
    (
        b"YUV4MPEG2",
        "a Y4M stream: pictures, not photon counts",
        "make counts of it with `qudi simulate - -o -`; a camera's 8-bit counts come through as `-f rawvideo`, read with `format raw-u8` `size HxW`",
    ),
    (b"\x1f\x8b", "gzipped data", "unpack them on the way: `gunzip -c FILE | qudi restore - ...`"),
    (b"II*\0", "a TIFF file", "name the file itself: its pages cannot be read in turn"),
    (b"MM\0*", "a TIFF file", "name the file itself: its pages cannot be read in turn"),
    (b"\x89HDF", "an HDF5 file", "name the file itself: its frames cannot be read in turn"),
    (b"PK\x03\x04", "a zip archive, perhaps .npz", "name the file itself, or pipe a .npy"),
    (b"\x89PNG", "a single picture", "put the frames into a folder and name that"),
];

/// Opens the stream of `reader`, recognised unless `options` name its format.
pub(crate) fn open_pipe(
    mut reader: Box<dyn Read + Send>,
    options: &ReadOptions,
) -> Result<(Box<dyn CountFrames>, CaptureInfo)> {
    let place = Path::new(STDIN);
    let options = &options.of_container(options.cfa.is_some());
    if options.frames_per_file.is_some() {
        return Err(Error::request(
            "a pipe has no files to count frames in",
            "frames_per_file",
            "leave it out, or end with `end`",
        ));
    }
    if let Some(name) = options.format.as_deref().filter(|&name| name != "npy") {
        return piped_raw(name, reader, options).unwrap_or_else(|| {
            Err(Error::request(
                format!("`{name}` cannot be read from a pipe"),
                "format",
                "pipes carry npy, raw-bits, raw-u8 and raw-u16: name the file itself, or `qudi convert` it",
            ))
        });
    }
    refuse_others(options, super::ARRAY_OPTIONS, "npy")?;
    let mut start = Vec::new();
    (&mut reader)
        .take(MAGIC_BYTES)
        .read_to_end(&mut start)
        .map_err(|e| Error::io("read", place, e))?;
    if start.is_empty() {
        return Err(Error::data(
            "nothing came through the pipe",
            place,
            "check the command before it",
        ));
    }
    if options.format.is_none() && !start.starts_with(b"\x93NUMPY") {
        let other = FOREIGN_STREAMS.iter().find(|(magic, _, _)| start.starts_with(magic));
        let (what, help) = other.map_or(
            (
                "no known format",
                "a .npy is recognised; raw frames are read with `format raw-bits`, raw-u8 or raw-u16 and `size HxW`",
            ),
            |&(_, what, help)| (what, help),
        );
        return Err(Error::data(what, place, help));
    }
    let mut reader: Box<dyn Read + Send> = Box::new(Cursor::new(start).chain(reader));
    let header = Header::read(&mut reader, place)?;
    let mut info = CaptureInfo::new("npy", "NumPy array");
    info.reasons.push("NumPy's magic number".to_owned());
    // The length of a frame follows from the order of the axes.
    let tail = Tail { trailer: 0, known: &[], lenient: options.lenient };
    let pipe = Pipe::new(reader, 0, None, tail);
    let frames =
        array(place, header, Place::Pipe(pipe)).open(options, &Hints::default(), &mut info)?;
    Ok((frames, info))
}
