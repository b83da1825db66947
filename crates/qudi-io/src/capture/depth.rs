//! The depth of counts, and the sums that fit into it.

use crate::description::{CaptureInfo, ReadOptions};
use qudi_core::{Error, Result};

/// Sets the depth that the user gives, unless the file contradicts it.
pub(super) fn state_depth(info: &mut CaptureInfo, bits: u8) -> Result<()> {
    if !(1..=16).contains(&bits) {
        return Err(Error::request(format!("{bits} bits"), "bits", "counts have 1 to 16 bits"));
    }
    let max = ((1u32 << bits) - 1) as u16;
    match info.max_count {
        Some(known) if known != max => Err(Error::request(
            format!("{bits} bits, where the file has counts up to {known}"),
            "bits",
            "leave it out: the file knows its depth",
        )),
        _ => {
            info.max_count = Some(max);
            Ok(())
        }
    }
}

/// Returns the source of the depth of a capture.
pub(super) fn depth_source(options: &ReadOptions, info: &CaptureInfo) -> &'static str {
    if options.levels.is_some() {
        "`levels`"
    } else if info.is_recorded() {
        "the record beside it"
    } else if options.bits.is_some() {
        "`bits`"
    } else {
        "the file itself"
    }
}

/// Refuses sums of no frames, of more frames than there are, and sums that do not fit into 16 bits.
pub(super) fn check_sum(sum: u32, frames: u64, info: &CaptureInfo) -> Result<()> {
    if sum == 0 || u64::from(sum) > frames {
        return Err(Error::request(
            format!("{sum} frames summed into one, of {frames}"),
            "sum",
            "sum between 1 and all frames",
        ));
    }
    if info.max_count.is_some_and(|max| u64::from(max) * u64::from(sum) > u64::from(u16::MAX)) {
        return Err(Error::request(
            format!("sums of {sum} frames do not fit into 16 bits"),
            "sum",
            "counts go up to 65535: sum fewer frames",
        ));
    }
    Ok(())
}
