//! Files without header of any camera, as the options `size`, `bitorder`, `header` and `trailer` describe
//! them. They are never guessed.

pub(super) mod files;

use super::Format;
use crate::codec::raw::files::{TRAILERS, frame_files};
use crate::description::{
    BitOrder, CaptureInfo, FormatOption, PackAxis, Packing, ReadOptions, refuse_others,
};
use crate::frames::CountFrames;
use crate::frames::frame_bytes::FrameBytes;
use crate::frames::packed::{PackedFrames, Placement, stored_bytes};
use crate::frames::pipe::{Pipe, STDIN, Tail};
use crate::frames::samples::{MONO, SampleFrames, Scale};
use crate::recognition::Probe;
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::io::Read;
use std::path::Path;

pub(crate) const BITS: Format = Format {
    name: "raw-bits",
    title: "packed bits without header",
    options: &BITS_OPTIONS,
    probe: |_| Ok(None),
    open: |probe, options, info| bits(options, info, &mut from_files(probe, options)),
};

pub(crate) const BYTES: Format = Format {
    name: "raw-u8",
    title: "one byte per count without header",
    options: &SAMPLES_OPTIONS,
    probe: |_| Ok(None),
    open: |probe, options, info| {
        samples(Sample::U8, &probe.path, options, info, &mut from_files(probe, options))
    },
};

pub(crate) const WORDS: Format = Format {
    name: "raw-u16",
    title: "two little-endian bytes per count without header",
    options: &SAMPLES_OPTIONS,
    probe: |_| Ok(None),
    open: |probe, options, info| {
        samples(WORD, &probe.path, options, info, &mut from_files(probe, options))
    },
};

const BITS_OPTIONS: [FormatOption; 7] = [
    FormatOption::Axes,
    FormatOption::BitOrder,
    FormatOption::PackAxis,
    FormatOption::Size,
    FormatOption::Header,
    FormatOption::Trailer,
    FormatOption::FramesPerFile,
];

const SAMPLES_OPTIONS: [FormatOption; 8] = [
    FormatOption::Axes,
    FormatOption::Size,
    FormatOption::Levels,
    FormatOption::Offset,
    FormatOption::Threshold,
    FormatOption::Header,
    FormatOption::Trailer,
    FormatOption::FramesPerFile,
];

const WORD: Sample = Sample::U16 { big_endian: false };

fn size(options: &ReadOptions) -> Result<Size> {
    options.size.ok_or_else(|| {
        Error::request(
            "files without header do not say how large a frame is",
            "size",
            "give height and width, as in `size 256x512`",
        )
    })
}

/// Lists the file, or every file of the folder.
fn files(probe: &Probe) -> Result<Vec<std::path::PathBuf>> {
    let files = probe.files(&["bin", "raw", "dat", ""])?;
    if files.is_empty() {
        return Err(Error::data(
            "the folder holds no .bin, .raw or .dat files",
            &probe.path,
            "name the file itself",
        ));
    }
    Ok(files)
}

/// A function that opens frames of a given number of bytes.
type Source<'a> = dyn FnMut(usize, &mut CaptureInfo) -> Result<FrameBytes> + 'a;

fn from_files<'a>(
    probe: &'a Probe,
    options: &'a ReadOptions,
) -> impl FnMut(usize, &mut CaptureInfo) -> Result<FrameBytes> + 'a {
    |frame_bytes, info| frame_files(&files(probe)?, frame_bytes, 0, options, info)
}

/// Opens frames of the raw format `name` from a pipe; `None` if there is no such format.
pub(crate) fn piped(
    name: &str,
    reader: Box<dyn Read + Send>,
    options: &ReadOptions,
) -> Option<Result<(Box<dyn CountFrames>, CaptureInfo)>> {
    let format = [BITS, BYTES, WORDS].into_iter().find(|format| format.name == name)?;
    if let Err(e) = refuse_others(options, format.options, format.name) {
        return Some(Err(e));
    }
    let mut info = CaptureInfo::new(format.name, format.title);
    info.reasons.push("`format`".to_owned());
    let mut reader = Some(reader);
    let mut source = |frame_bytes: usize, _: &mut CaptureInfo| {
        // Called once: the reader moves with the frames.
        let mut reader = reader.take().unwrap_or_else(|| Box::new(std::io::empty()));
        let header = options.header.unwrap_or(0);
        std::io::copy(&mut (&mut reader).take(header), &mut std::io::sink())
            .map_err(|e| Error::io("read", Path::new(STDIN), e))?;
        let trailer = options.trailer.unwrap_or(0);
        let tail = Tail { trailer, known: &TRAILERS, lenient: options.lenient };
        Ok(FrameBytes::Pipe(Pipe::new(reader, frame_bytes, None, tail)))
    };
    let place = Path::new(STDIN);
    let frames = match name {
        "raw-bits" => bits(options, &mut info, &mut source),
        "raw-u8" => samples(Sample::U8, place, options, &mut info, &mut source),
        _ => samples(WORD, place, options, &mut info, &mut source),
    };
    Some(frames.map(|frames| (frames, info)))
}

/// Returns true if columns are stored before rows. Frames of raw files are stored one after the other.
fn transposed(options: &ReadOptions) -> Result<bool> {
    let axes = options.axes.unwrap_or_default();
    if axes.frame_position() == 0 {
        return Ok(axes.transposed());
    }
    Err(Error::request(
        "frames of files without header come one after the other",
        "axes",
        "use thw or twh; another order is read from .npy",
    ))
}

fn bits(
    options: &ReadOptions,
    info: &mut CaptureInfo,
    source: &mut Source<'_>,
) -> Result<Box<dyn CountFrames>> {
    let size = size(options)?;
    let axis = match options.pack_axis {
        Some(axis @ (PackAxis::Width | PackAxis::Height)) => axis,
        None => PackAxis::Width,
        Some(PackAxis::None) => {
            return Err(Error::request(
                "raw-bits holds packed bits",
                "pack_axis",
                "name the axis, width or height, or read one byte per count as raw-u8",
            ));
        }
    };
    let (rows, columns) = stored_bytes(size, axis);
    let bytes = source(rows * columns, info)?;
    let order = options.bit_order.unwrap_or(BitOrder::Msb);
    info.max_count = Some(1);
    info.packing = Some(Packing { axis, order });
    let transposed = transposed(options)?;
    let placement = Placement::packed(size, axis, transposed);
    Ok(Box::new(PackedFrames::new(bytes, order, size, placement)))
}

fn samples(
    sample: Sample,
    place: &Path,
    options: &ReadOptions,
    info: &mut CaptureInfo,
    source: &mut Source<'_>,
) -> Result<Box<dyn CountFrames>> {
    let size = size(options)?;
    let bytes = source(size.pixels() * sample.bytes(), info)?;
    let full = sample.full_scale().unwrap_or(1.0);
    let scale = Scale::asked(options, full, info).unwrap_or(Scale::Counts);
    let transposed = transposed(options)?;
    Ok(Box::new(SampleFrames::new(bytes, sample, size, transposed, MONO, scale, place)))
}
