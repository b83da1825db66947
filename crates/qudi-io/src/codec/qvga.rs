//! Edinburgh QVGA SPAD (Dutton et al. 2016): frames of `yrange` x 320 bits, lowest bit first.
//!
//! Without header, or with the 3 bytes of the MATLAB interface: exposure index, `yrange`, global
//! shutter; a rolling-shutter file of exposure 1 starts with `yrange * 80` bytes to skip.

use super::{Format, Recognition};
use crate::codec::raw::files::frame_files;
use crate::description::{BitOrder, CaptureInfo, Certainty, PackAxis, Packing, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::packed::{PackedFrames, Placement};
use crate::recognition::{ByteKind, Probe};
use qudi_core::Size;
use qudi_core::{Error, Result};

pub(crate) const FORMAT: Format = Format {
    name: "qvga",
    title: "Edinburgh QVGA SPAD raw file",
    options: super::SIZED_BIT_FILE_OPTIONS,
    probe: recognise,
    open,
};

const WIDTH: usize = 320;
const HEIGHT: usize = 240;

/// Frames per second of this sensor's usual configuration.
const FPS: f64 = 9938.4;

/// The header of the MATLAB interface, 3 bytes.
struct Header {
    yrange: usize,
    /// Bytes before the first frame.
    start: u64,
    rolling: bool,
}

impl Header {
    fn parse(head: &[u8]) -> Option<Self> {
        let &[mean_level, yrange, global, ..] = head else { return None };
        if !(8..=HEIGHT as u8).contains(&yrange) || global > 1 {
            return None;
        }
        let skipped = if global == 0 && mean_level == 1 { u64::from(yrange) * 80 } else { 0 };
        Some(Self { yrange: usize::from(yrange), start: 3 + skipped, rolling: global == 0 })
    }

    /// Returns the header of a file of `length` bytes, if it has one: frames must fill the rest.
    fn of(head: &[u8], length: u64) -> Option<Self> {
        let plain = length.is_multiple_of((HEIGHT * WIDTH / 8) as u64);
        let header = Self::parse(head)?;
        let body = length.checked_sub(header.start)?;
        (!plain && body.is_multiple_of((header.yrange * WIDTH / 8) as u64)).then_some(header)
    }
}

fn recognise(probe: &Probe) -> Result<Option<Recognition>> {
    if !probe.has_extension(&["bin", "raw"]) {
        return Ok(None);
    }
    let named = probe.stem().starts_with("spc_data");
    let plain = probe.length.is_multiple_of((HEIGHT * WIDTH / 8) as u64);
    let header = Header::of(&probe.head, probe.length).is_some();
    if !plain && !header {
        return Ok(None);
    }
    if ByteKind::of(&probe.middle(1)?) == ByteKind::Counts {
        return Ok(None);
    }
    let reasons: &[&str] = match (named, header) {
        (true, true) => &["the name", "the header of its MATLAB interface"],
        (true, false) => &["the name", "whole frames of 9600 bytes"],
        (false, true) => &["the header of its MATLAB interface"],
        (false, false) => &["whole frames of 9600 bytes"],
    };
    let certainty = if named { Certainty::Likely } else { Certainty::Possible };
    Ok(Some(Recognition::new(certainty, reasons)))
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    if probe.is_folder {
        return Err(Error::data("a folder", &probe.path, "name one spc_data<N>.bin"));
    }
    let header = match options.header {
        Some(_) => None,
        None => Header::of(&probe.head, probe.length),
    };
    let rows = header.as_ref().map_or(HEIGHT, |header| header.yrange);
    let size = options.size.unwrap_or(Size { height: rows, width: WIDTH });
    if !size.width.is_multiple_of(8) {
        return Err(Error::request(
            format!("rows of {} bits are not whole bytes", size.width),
            "size",
            "this sensor has 320 columns",
        ));
    }
    if header.as_ref().is_some_and(|header| header.rolling) {
        info.notes.push("rolling shutter: rows are exposed one after the other".to_owned());
    }
    let start = header.map_or(0, |header| header.start);
    let files = [probe.path.clone()];
    let bytes = frame_files(&files, size.pixels() / 8, start, options, info)?;
    let order = options.bit_order.unwrap_or(BitOrder::Lsb);
    info.max_count = Some(1);
    info.fps = Some(FPS);
    info.preset = Some("spad-qvga");
    info.packing = Some(Packing { axis: PackAxis::Width, order });
    Ok(Box::new(PackedFrames::new(bytes, order, size, Placement::Straight)))
}
