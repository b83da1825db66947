//! Headerless files of equally long frames, one or many.

use crate::description::{CaptureInfo, ReadOptions};
use crate::frames::frame_bytes::{FrameBytes, Segment};
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Trailers that camera servers append to a stream of frames.
pub(crate) const TRAILERS: [&[u8]; 2] = [b"DONE", b"ERROR"];

/// Bytes before each frame that cameras write at most.
const MAX_FRAME_HEADER: u64 = 4096;

/// Opens the frames of `files`, `frame_bytes` each, after `header` bytes.
pub(crate) fn frame_files(
    files: &[PathBuf],
    frame_bytes: usize,
    header: u64,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<FrameBytes> {
    let mut segments = Vec::with_capacity(files.len());
    for (i, path) in files.iter().enumerate() {
        let last = i + 1 == files.len();
        let mut segment = segment(path, frame_bytes as u64, header, options, info)?;
        if let Some(per_file) = options.frames_per_file {
            if segment.frames > per_file {
                segment.frames = per_file;
            } else if segment.frames < per_file && !last {
                return Err(Error::data(
                    format!("the file holds {} frames instead of {per_file}", segment.frames),
                    path,
                    "only the last file may be shorter; leave `frames_per_file` out, or copy the file again",
                ));
            }
        }
        let shorter = segments.first().is_some_and(|f: &Segment| segment.frames < f.frames);
        if shorter && !last {
            info.notes.push(format!(
                "{} holds {} frames, fewer than the files before it: frames may be missing",
                path.display(),
                segment.frames
            ));
        }
        if segment.frames > 0 {
            segments.push(segment);
        }
    }
    if segments.is_empty() {
        let place = files.first().map_or(Path::new("the folder"), PathBuf::as_path);
        return Err(Error::data(
            format!("no whole frame of {frame_bytes} bytes"),
            place,
            "check `format` and `size`",
        ));
    }
    Ok(FrameBytes::files(segments, frame_bytes))
}

fn segment(
    path: &Path,
    frame_bytes: u64,
    header: u64,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Segment> {
    let io = |e| Error::io("open", path, e);
    let mut file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let header = options.header.unwrap_or(header);
    let too_short = || {
        Error::data(
            format!("{length} bytes, shorter than its header and trailer"),
            path,
            "check `header` and `trailer`, or copy the file again",
        )
    };
    let body = length.checked_sub(header).ok_or_else(too_short)?;
    let trailer = match options.trailer {
        Some(trailer) => trailer,
        None => trailer(&mut file, body % frame_bytes, path, info)?,
    };
    let body = body.checked_sub(trailer).ok_or_else(too_short)?;
    let rest = body % frame_bytes;
    if rest != 0 {
        if !options.lenient {
            return Err(Error::data(
                format!(
                    "{length} bytes are {} frames of {frame_bytes} bytes and {rest} bytes more",
                    body / frame_bytes
                ),
                path,
                advice(body, frame_bytes),
            ));
        }
        info.notes
            .push(format!("{}: incomplete last frame of {rest} bytes dropped", path.display()));
    }
    Ok(Segment { path: path.to_owned(), start: header, frames: body / frame_bytes })
}

/// Returns what to do with `body` bytes that are no whole frames.
fn advice(body: u64, frame_bytes: u64) -> String {
    let mut fits = Vec::new();
    // Samples of 12 bits lie in words of 16, or closer.
    if frame_bytes.is_multiple_of(4) && body.is_multiple_of(frame_bytes / 4 * 3) {
        fits.push("12-bit packed pixels (Mono12p), to be unpacked to 16 bits first".to_owned());
    }
    let headers = (1..=(frame_bytes / 4).min(MAX_FRAME_HEADER) / 4).map(|words| 4 * words);
    let whole = |header: &u64| body.is_multiple_of(frame_bytes + header);
    if let Some(header) = { headers }.find(whole).filter(|header| body > frame_bytes + header) {
        let frames = body / (frame_bytes + header);
        fits.push(format!("{frames} frames with headers of {header} bytes, to be cut off first"));
    }
    let usual = "drop an incomplete last frame with `lenient`";
    if fits.is_empty() {
        let rest = body % frame_bytes;
        return format!(
            "{usual}, or a trailer with `trailer {rest}`; or check `format` and `size`"
        );
    }
    format!("their length fits {}; {usual}; or check `format` and `size`", fits.join(", or "))
}

/// Returns the length of a known trailer, if the `rest` bytes beyond whole frames are one.
fn trailer(file: &mut File, rest: u64, path: &Path, info: &mut CaptureInfo) -> Result<u64> {
    let Some(known) = TRAILERS.iter().find(|known| known.len() as u64 == rest) else {
        return Ok(0);
    };
    let mut end = vec![0u8; known.len()];
    let io = |e| Error::io("read the end of", path, e);
    file.seek(SeekFrom::End(-(known.len() as i64))).map_err(io)?;
    file.read_exact(&mut end).map_err(io)?;
    if end != *known {
        return Ok(0);
    }
    if *known == b"ERROR" {
        info.notes.push(format!(
            "{} ends in ERROR: the camera stopped before the capture was complete",
            path.display()
        ));
    }
    Ok(rest)
}

/// Returns true if the file ends in a known trailer.
pub(crate) fn ends_in_trailer(path: &Path) -> bool {
    let read = || -> std::io::Result<[u8; 4]> {
        let mut end = [0u8; 4];
        let mut file = File::open(path)?;
        file.seek(SeekFrom::End(-4))?;
        file.read_exact(&mut end)?;
        Ok(end)
    };
    read().is_ok_and(|end| &end == b"DONE" || &end == b"RROR")
}
