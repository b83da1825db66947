//! NumPy `.npz`: the one array in it that is a capture.

use super::array::{Hints, Place};
use super::npy::{array, refuse_bomb};
use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::checksum::CrcReader;
use crate::frames::frame_bytes::{Checksum, Opener};
use crate::recognition::Probe;
use flate2::read::DeflateDecoder;
use qudi_core::npy::Header;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use zip::{CompressionMethod, ZipArchive};

pub(crate) const FORMAT: Format = Format {
    name: "npz",
    title: "NumPy archive",
    options: super::ARRAYS_OPTIONS,
    probe: |probe| {
        let found = probe.head.starts_with(b"PK\x03\x04") && probe.extension == "npz";
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["zip's magic number", "the name"])))
    },
    open,
};

/// An entry of the archive.
#[derive(Clone, Debug)]
struct Entry {
    name: String,
    start: u64,
    compressed: u64,
    deflated: bool,
    crc32: u32,
    header: Header,
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    let entries = entries(path)?;
    let entry = choose(&entries, options, path)?.clone();
    refuse_bomb(&entry.header, entry.compressed, path)?;
    info.reasons.push(format!("array `{}`", entry.name));
    let data_start = entry.header.data_start;
    let place = if entry.deflated {
        let (path, entry) = (path.clone(), entry.clone());
        let opener: Opener = Box::new(move || {
            let mut stream = entry.stream(&path)?;
            std::io::copy(&mut stream.by_ref().take(data_start), &mut std::io::sink())
                .map_err(|e| Error::io("decompress", &path, e))?;
            Ok(stream)
        });
        Place::Stream(opener)
    } else {
        Place::File {
            start: entry.start + data_start,
            available: entry.compressed.saturating_sub(data_start),
            checksum: Some(Checksum {
                expected: entry.crc32,
                range: entry.start..entry.start + entry.compressed,
            }),
        }
    };
    array(path, entry.header, place).open(options, &Hints::default(), info)
}

impl Entry {
    fn stream(&self, path: &Path) -> Result<Box<dyn Read + Send>> {
        let stream = stream(path, self.start, self.compressed, self.deflated)?;
        Ok(Box::new(CrcReader::new(stream, self.crc32)))
    }
}

fn stream(
    path: &Path,
    start: u64,
    compressed: u64,
    deflated: bool,
) -> Result<Box<dyn Read + Send>> {
    let io = |e| Error::io("open", path, e);
    let mut file = File::open(path).map_err(io)?;
    file.seek(SeekFrom::Start(start)).map_err(io)?;
    let stored = BufReader::with_capacity(1 << 16, file.take(compressed));
    Ok(if deflated { Box::new(DeflateDecoder::new(stored)) } else { Box::new(stored) })
}

/// Lists the arrays of the archive whose samples could be counts.
fn entries(path: &Path) -> Result<Vec<Entry>> {
    let damaged = |e: zip::result::ZipError| {
        Error::data(
            format!("not a readable .npz: {e}"),
            path,
            "write it with numpy.savez or numpy.savez_compressed",
        )
    };
    let io = |e| Error::io("open", path, e);
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut archive = ZipArchive::new(BufReader::new(file)).map_err(damaged)?;
    let mut entries = Vec::new();
    for i in 0..archive.len() {
        let file = archive.by_index_raw(i).map_err(damaged)?;
        let name = file.name().map_err(damaged)?;
        let Some(name) = name.strip_suffix(".npy").map(str::to_owned) else { continue };
        if file.encrypted() {
            return Err(Error::data(
                format!("array `{name}` is encrypted"),
                path,
                "unpack it with its password, and write it again with numpy.savez",
            ));
        }
        let crc32 = file.crc32();
        let deflated = match file.compression() {
            CompressionMethod::Stored => false,
            CompressionMethod::Deflated => true,
            _ => continue,
        };
        let Some(start) = file.data_start() else { continue };
        let compressed = file.compressed_size();
        if start.checked_add(compressed).is_none_or(|end| end > length) {
            return Err(Error::data(
                format!("array `{name}` reaches beyond the end of the file"),
                path,
                "the file is truncated or damaged: copy or export it again",
            ));
        }
        // Other arrays, of text for example, are skipped.
        let header = Header::read(&mut stream(path, start, compressed, deflated)?, path);
        if let Ok(header) = header {
            entries.push(Entry { name, start, compressed, deflated, crc32, header });
        }
    }
    Ok(entries)
}

fn choose<'a>(entries: &'a [Entry], options: &ReadOptions, path: &Path) -> Result<&'a Entry> {
    let listed = || {
        let names: Vec<_> =
            entries.iter().map(|e| format!("{} {:?}", e.name, e.header.shape)).collect();
        names.join(", ")
    };
    if let Some(wanted) = &options.array {
        return entries.iter().find(|e| e.name == *wanted).ok_or_else(|| {
            Error::data(
                format!("no array `{wanted}` in it"),
                path,
                format!("there are {}", listed()),
            )
        });
    }
    let mut captures = entries.iter().filter(|e| e.header.shape.len() >= 3);
    match (captures.next(), captures.next()) {
        (Some(one), None) => Ok(one),
        (None, _) => Err(Error::data(
            format!("no array of frames in it; there are {}", listed()),
            path,
            "save one array of shape (frames, height, width)",
        )),
        (Some(_), Some(_)) => Err(Error::data(
            format!("several arrays could be the capture: {}", listed()),
            path,
            "name one with `array`",
        )),
    }
}
