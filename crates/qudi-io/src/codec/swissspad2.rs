//! SwissSPAD2 (EPFL) as its own software writes it: files of 8 MiB, lowest bit first.
//!
//! Half array: 512 frames of 256 x 512 per file, rows one after the other. Full array: 256 frames
//! of 512 x 512; each of 256 stored rows holds 8 zones of 128 pixels, alternately of image row `r`
//! and, upside down, of image row `511 - r`.

use super::{Format, Recognition};
use crate::codec::raw::files::frame_files;
use crate::description::{BitOrder, CaptureInfo, Certainty, PackAxis, Packing, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::packed::{PackedFrames, Placement};
use crate::recognition::{ByteKind, Convention, Probe, SWISSSPAD_FILE_BYTES};
use qudi_core::Result;
use qudi_core::Size;

pub(crate) const HALF_ARRAY: Format = Format {
    name: "swissspad2",
    title: "SwissSPAD2 raw files, half array",
    options: super::BIT_FILE_OPTIONS,
    probe: |probe| recognise(probe, false),
    open: |probe, options, info| {
        open(probe, options, info, Size { height: 256, width: 512 }, Placement::Straight)
    },
};

pub(crate) const FULL_ARRAY: Format = Format {
    name: "swissspad2-full",
    title: "SwissSPAD2 raw files, full array",
    options: super::BIT_FILE_OPTIONS,
    probe: |probe| recognise(probe, true),
    open: |probe, options, info| {
        let size = Size { height: 512, width: 512 };
        open(probe, options, info, size, Placement::Bytes(zones()))
    },
};

/// Bytes of a half-array frame; a full one has twice as many.
const HALF_FRAME: u64 = 16_384;

fn recognise(probe: &Probe, full: bool) -> Result<Option<Recognition>> {
    let Some(sample) = probe.raw_sample()? else { return Ok(None) };
    let frame = if full { 2 * HALF_FRAME } else { HALF_FRAME };
    if !sample.length.is_multiple_of(frame) || sample.kind == ByteKind::Counts {
        return Ok(None);
    }
    let mut reasons = Vec::new();
    if sample.length == SWISSSPAD_FILE_BYTES {
        reasons.push("8 MiB per file");
    }
    if sample.convention == Convention::SwissSpad2 {
        reasons.push("the name");
    }
    let arrangement = sample.full_array.unwrap_or(false);
    let certainty = match (sample.convention, sample.order) {
        (Convention::Spad512s, _) | (_, Some(BitOrder::Msb)) => return Ok(None),
        _ if arrangement != full => return Ok(None),
        (_, Some(BitOrder::Lsb)) => {
            reasons.push(if full {
                "the picture: lowest bit first, zones"
            } else {
                "the picture: lowest bit first"
            });
            Certainty::Likely
        }
        (Convention::SwissSpad2, None) => Certainty::Likely,
        (Convention::Unknown, None) => Certainty::Possible,
    };
    Ok(Some(Recognition::new(certainty, &reasons)))
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
    size: Size,
    placement: Placement,
) -> Result<Box<dyn CountFrames>> {
    let files = probe.files(&["bin"])?;
    let bytes = frame_files(&files, size.pixels() / 8, 0, options, info)?;
    let order = options.bit_order.unwrap_or(BitOrder::Lsb);
    info.max_count = Some(1);
    info.packing = Some(Packing { axis: PackAxis::Width, order });
    info.preset = Some("swissspad2");
    Ok(Box::new(PackedFrames::new(bytes, order, size, placement)))
}

/// Returns the image byte of every stored byte of a full-array frame.
fn zones() -> Vec<u32> {
    let byte = |i: u32| {
        let (row, zone, x) = (i / 128, i / 16 % 8, i % 16);
        let y = if zone % 2 == 0 { row } else { 511 - row };
        y * 64 + zone / 2 * 16 + x
    };
    (0..512 * 64).map(byte).collect()
}
