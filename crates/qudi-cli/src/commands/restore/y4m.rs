//! Y4M on standard output, for players and encoders.

use crate::error::{Result, stdout_error};
use qudi_core::{Frame, Size};
use std::io::Write;

/// Writes the header of a gray Y4M stream to standard output.
pub(super) fn write_header(size: Size, fps: f64) -> Result<()> {
    let thousandths = (fps * 1000.0).round() as u64;
    let (numerator, denominator) = if thousandths.is_multiple_of(1000) {
        (thousandths / 1000, 1)
    } else {
        (thousandths, 1000)
    };
    // Without the tag, readers take luma for the limited range of video, 16 to 235.
    let header = format!(
        "YUV4MPEG2 W{} H{} F{numerator}:{denominator} Ip A1:1 Cmono XCOLORRANGE=FULL\n",
        size.width, size.height
    );
    std::io::stdout().write_all(header.as_bytes()).map_err(stdout_error)
}

/// Writes a frame to standard output.
pub(super) fn write_frame(frame: &Frame) -> std::io::Result<()> {
    let mut bytes = b"FRAME\n".to_vec();
    bytes.extend(frame.data.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8));
    let mut out = std::io::stdout().lock();
    // A live picture must not wait for the next one.
    out.write_all(&bytes).and_then(|()| out.flush())
}
