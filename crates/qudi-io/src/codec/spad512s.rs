//! SPAD512S (Pi Imaging): `RAW00000.bin` of up to 1000 frames, or dumps of its server's stream,
//! which end in `DONE`. One bit, highest bit first; 4 to 8 bits in a byte; 9 to 12 in two.
//! The vendor's software turns frames by a quarter to the left.

use super::{Format, Recognition};
use crate::capture::byte_kind::ByteKind;
use crate::capture::format_options::FormatOption;
use crate::capture::info::{CaptureInfo, Certainty, Packing};
use crate::capture::options::{BitOrder, Orientation, PackAxis, ReadOptions};
use crate::capture::probe::Probe;
use crate::capture::raw_sample::{Convention, FRAME};
use crate::codec::raw::files::{ends_in_trailer, frame_files};
use crate::frames::CountFrames;
use crate::frames::packed::{PackedFrames, Placement, stored_bytes};
use crate::frames::samples::{MONO, SampleFrames, Scale};
use qudi_core::Result;
use qudi_core::Size;
use qudi_core::npy::Sample;

/// Options of files of one count a pixel.
const COUNTS: &[FormatOption] =
    &[FormatOption::Size, FormatOption::Header, FormatOption::Trailer, FormatOption::FramesPerFile];

/// The whole array; narrower read-outs are given with `size`.
const ARRAY: Size = Size { height: 512, width: 512 };

pub(crate) const BINARY: Format = Format {
    name: "spad512s",
    title: "SPAD512S raw files, 1 bit",
    options: super::SIZED_BIT_FILES,
    probe: |probe| recognise(probe, ByteKind::Packed, FRAME as u64),
    open: open_binary,
};

pub(crate) const BYTES: Format = Format {
    name: "spad512s-8",
    title: "SPAD512S raw files, 4 to 8 bits",
    options: COUNTS,
    probe: |probe| recognise(probe, ByteKind::Counts, 8 * FRAME as u64),
    open: |probe, options, info| open_samples(probe, options, info, Sample::U8),
};

pub(crate) const WORDS: Format = Format {
    name: "spad512s-16",
    title: "SPAD512S raw files, 9 to 12 bits",
    options: COUNTS,
    probe: |probe| recognise(probe, ByteKind::WideCounts, 16 * FRAME as u64),
    open: |probe, options, info| {
        open_samples(probe, options, info, Sample::U16 { big_endian: false })
    },
};

fn recognise(probe: &Probe, kind: ByteKind, frame: u64) -> Result<Option<Recognition>> {
    let Some(sample) = probe.raw_sample()? else { return Ok(None) };
    let binary = kind == ByteKind::Packed;
    let fits = match sample.kind {
        // A dark capture could be of any depth; the common one is meant.
        ByteKind::Unclear => binary,
        seen => seen == kind,
    };
    let first = probe.files(&["bin"])?.into_iter().next().unwrap_or_default();
    let trailer = ends_in_trailer(&first);
    let body = sample.length - if trailer { 4 } else { 0 };
    if !fits || !body.is_multiple_of(frame) || body == 0 {
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

fn open_binary(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    common(info);
    let size = options.size.unwrap_or(ARRAY);
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
    let size = options.size.unwrap_or(ARRAY);
    let files = probe.files(&["bin"])?;
    let bytes = frame_files(&files, size.pixels() * sample.bytes(), 0, options, info)?;
    let scale = Scale::Counts;
    Ok(Box::new(SampleFrames::new(bytes, sample, size, false, MONO, scale, &probe.path)))
}
