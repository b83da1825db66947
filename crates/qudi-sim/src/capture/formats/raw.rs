//! Files without header of any camera, described by the user: `--size`, `--bitorder`, `--header`,
//! `--trailer`. Never guessed.

use super::Format;
use super::raw_files::frame_files;
use crate::capture::about::{About, Packing};
use crate::capture::count_frames::CountFrames;
use crate::capture::options::{BitOrder, PackAxis, ReadOptions};
use crate::capture::packed::{PackedFrames, Placement, stored_bytes};
use crate::capture::probe::Probe;
use crate::capture::samples::{MONO, SampleFrames, Scale};
use crate::error::{Result, SimError};
use crate::frame::Size;
use crate::npy::Sample;

pub(super) const BITS: Format = Format {
    name: "raw-bits",
    title: "packed bits without header",
    probe: |_| Ok(None),
    open: |probe, options, about| {
        let size = size(options)?;
        let axis = match options.pack_axis {
            Some(axis @ (PackAxis::Width | PackAxis::Height)) => axis,
            Some(PackAxis::None) | None => PackAxis::Width,
        };
        let (rows, columns) = stored_bytes(size, axis);
        let bytes = frame_files(&files(probe)?, rows * columns, 0, options, about)?;
        let order = options.bit_order.unwrap_or(BitOrder::Msb);
        about.max_count = Some(1);
        about.packing = Some(Packing { axis, order });
        let transposed = options.axes.is_some_and(crate::capture::options::Axes::transposed);
        let placement = Placement::packed(size, axis, transposed);
        Ok(Box::new(PackedFrames::new(bytes, order, size, placement)))
    },
};

pub(super) const BYTES: Format = Format {
    name: "raw-u8",
    title: "one byte per count without header",
    probe: |_| Ok(None),
    open: |probe, options, about| samples(probe, options, about, Sample::U8),
};

pub(super) const WORDS: Format = Format {
    name: "raw-u16",
    title: "two little-endian bytes per count without header",
    probe: |_| Ok(None),
    open: |probe, options, about| samples(probe, options, about, Sample::U16 { big_endian: false }),
};

fn size(options: &ReadOptions) -> Result<Size> {
    options.size.ok_or_else(|| {
        SimError::request(
            "files without header do not say how large a frame is",
            "--size",
            "give height and width, as in --size 256x512",
        )
    })
}

/// The file, or every file of the folder.
fn files(probe: &Probe) -> Result<Vec<std::path::PathBuf>> {
    let files = probe.files(&["bin", "raw", "dat", ""])?;
    if files.is_empty() {
        return Err(SimError::data(
            "the folder holds no .bin, .raw or .dat files",
            &probe.path,
            "name the file itself",
        ));
    }
    Ok(files)
}

fn samples(
    probe: &Probe,
    options: &ReadOptions,
    about: &mut About,
    sample: Sample,
) -> Result<Box<dyn CountFrames>> {
    let size = size(options)?;
    let bytes = frame_files(&files(probe)?, size.pixels() * sample.bytes(), 0, options, about)?;
    let full = sample.full_scale().unwrap_or(1.0);
    let scale = Scale::asked(options.levels, full, about).unwrap_or(Scale::Counts);
    let transposed = options.axes.is_some_and(crate::capture::options::Axes::transposed);
    Ok(Box::new(SampleFrames::new(bytes, sample, size, transposed, MONO, scale, &probe.path)))
}
