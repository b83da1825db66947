//! SPAD512S (Pi Imaging): `RAW00000.bin` of up to 1000 frames, or dumps of its server's stream,
//! which end in `DONE`. One bit, highest bit first; 4 to 8 bits in a byte; 9 to 12 in two.
//! The vendor's software turns frames by a quarter to the left.

mod region;

use super::{Format, Recognition};
use crate::codec::raw::files::{ends_in_trailer, frame_files};
use crate::description::{
    BitOrder, CaptureInfo, Certainty, FormatOption, Orientation, PackAxis, Packing, ReadOptions,
};
use crate::frames::CountFrames;
use crate::frames::packed::{PackedFrames, Placement, stored_bytes};
use crate::frames::samples::{MONO, SampleFrames, Scale};
use crate::recognition::{ByteKind, Convention, Probe};
use qudi_core::Size;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::Read;

/// Options of files with one count per sample.
const COUNT_OPTIONS: &[FormatOption] = &[
    FormatOption::Size,
    FormatOption::Offset,
    FormatOption::Threshold,
    FormatOption::Header,
    FormatOption::Trailer,
    FormatOption::FramesPerFile,
];

/// Bytes from which the width of rows is measured.
const SAMPLED_BYTES: u64 = 1 << 20;

/// Size of the whole array; narrower read-outs show by their rows, or are given with `size`.
const ARRAY: Size = Size { height: 512, width: 512 };

pub(crate) const BINARY: Format = Format {
    name: "spad512s",
    title: "SPAD512S raw files, 1 bit",
    options: super::SIZED_BIT_FILE_OPTIONS,
    probe: |probe| recognise(probe, ByteKind::Packed),
    open: open_binary,
};

pub(crate) const BYTES: Format = Format {
    name: "spad512s-8",
    title: "SPAD512S raw files, 4 to 8 bits",
    options: COUNT_OPTIONS,
    probe: |probe| recognise(probe, ByteKind::Counts),
    open: |probe, options, info| open_samples(probe, options, info, Sample::U8),
};

pub(crate) const WORDS: Format = Format {
    name: "spad512s-16",
    title: "SPAD512S raw files, 9 to 12 bits",
    options: COUNT_OPTIONS,
    probe: |probe| recognise(probe, ByteKind::WideCounts),
    open: |probe, options, info| {
        open_samples(probe, options, info, Sample::U16 { big_endian: false })
    },
};

/// Returns the bytes of a frame of `size`.
fn frame_bytes(size: Size, kind: ByteKind) -> u64 {
    (match kind {
        ByteKind::Packed | ByteKind::Unclear => size.height * size.width.div_ceil(8),
        ByteKind::Counts => size.pixels(),
        ByteKind::WideCounts => 2 * size.pixels(),
    }) as u64
}

fn recognise(probe: &Probe, kind: ByteKind) -> Result<Option<Recognition>> {
    let Some(sample) = probe.raw_sample()? else { return Ok(None) };
    let binary = kind == ByteKind::Packed;
    let fits = match sample.kind {
        // A dark capture could have any depth; the common one is assumed.
        ByteKind::Unclear => binary,
        seen => seen == kind,
    };
    let first = probe.files(&["bin"])?.into_iter().next().unwrap_or_default();
    let trailer = ends_in_trailer(&first);
    let body = sample.length - if trailer { 4 } else { 0 };
    // A region of interest has frames of another length; then the camera must show otherwise.
    let known = sample.convention == Convention::Spad512s || trailer;
    let frame = frame_bytes(probe.size.unwrap_or(ARRAY), kind);
    let whole = body.is_multiple_of(frame);
    if !fits || body == 0 || !(whole || known && probe.size.is_none()) {
        return Ok(None);
    }
    let mut reasons = Vec::new();
    if sample.convention == Convention::Spad512s {
        reasons.push("the name");
    }
    if trailer {
        reasons.push("a trailer of the camera's server");
    }
    let picture = binary && sample.order == Some(BitOrder::Msb);
    if picture {
        reasons.push("the picture: highest bit first");
    }
    let certainty = match sample.convention {
        Convention::SwissSpad2 if !trailer && !picture => return Ok(None),
        // Lowest bit first: another camera, whatever the length.
        Convention::Unknown if binary && sample.order == Some(BitOrder::Lsb) => return Ok(None),
        _ if reasons.is_empty() => Certainty::Possible,
        _ => Certainty::Likely,
    };
    Ok(Some(Recognition::new(certainty, &reasons)))
}

fn common(info: &mut CaptureInfo) {
    info.preset = Some("spad512s");
    info.vendor = Orientation::Rot90;
    info.orient = Orientation::Vendor;
}

/// Returns the size of frames: given, or as their rows show.
fn frame_size(probe: &Probe, kind: ByteKind, options: &ReadOptions) -> Result<Size> {
    if let Some(size) = options.size {
        return Ok(size);
    }
    // With a header or a trailer of its own, nothing is inferred.
    if options.header.is_some() || options.trailer.is_some() {
        return Ok(ARRAY);
    }
    let first = probe.files(&["bin"])?.into_iter().next().unwrap_or_default();
    let io = |e| Error::io("read", &first, e);
    let file = File::open(&first).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut bytes = Vec::new();
    file.take(SAMPLED_BYTES).read_to_end(&mut bytes).map_err(io)?;
    let body = length - if ends_in_trailer(&first) { length.min(4) } else { 0 };
    let samples: Vec<f32> = match kind {
        ByteKind::Packed | ByteKind::Unclear => {
            let bits = bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1));
            bits.map(f32::from).collect()
        }
        ByteKind::Counts => bytes.iter().map(|&byte| f32::from(byte)).collect(),
        ByteKind::WideCounts => {
            let words = bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]]));
            words.map(f32::from).collect()
        }
    };
    let size = region::frame_size(&samples, body, |size| frame_bytes(size, kind), &first);
    match size {
        // An incomplete last frame of a whole array is dropped.
        Err(_) if options.lenient => Ok(ARRAY),
        other => other,
    }
}

fn open_binary(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    common(info);
    let size = frame_size(probe, ByteKind::Packed, options)?;
    let (rows, columns) = stored_bytes(size, PackAxis::Width);
    let bytes = frame_files(&probe.files(&["bin"])?, rows * columns, 0, options, info)?;
    let order = options.bit_order.unwrap_or(BitOrder::Msb);
    info.max_count = Some(1);
    info.packing = Some(Packing { axis: PackAxis::Width, order });
    let placement = Placement::packed(size, PackAxis::Width, false);
    Ok(Box::new(PackedFrames::new(bytes, order, size, placement)))
}

fn open_samples(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
    sample: Sample,
) -> Result<Box<dyn CountFrames>> {
    common(info);
    let kind = if sample == Sample::U8 { ByteKind::Counts } else { ByteKind::WideCounts };
    let size = frame_size(probe, kind, options)?;
    let files = probe.files(&["bin"])?;
    let bytes = frame_files(&files, size.pixels() * sample.bytes(), 0, options, info)?;
    let full = sample.full_scale().unwrap_or(1.0);
    let scale = Scale::asked(options, full, info).unwrap_or(Scale::Counts);
    Ok(Box::new(SampleFrames::new(bytes, sample, size, false, MONO, scale, &probe.path)))
}
