//! Captures as commands read them, each value made from the one before: [`Source`],
//! [`OpenedCapture`](source::OpenedCapture), [`SummedCapture`], [`AlignedCapture`], [`CaptureAcquisition`].

mod acquisition;
mod aligned;
mod input;
mod planes;
mod source;
mod summed;
pub(crate) mod warnings;

pub(crate) use acquisition::{CaptureAcquisition, LightOverrides, checked_mean_level};
pub(crate) use aligned::{AlignedCapture, Alignment};
pub use input::Input;
pub(crate) use planes::OtherPlanes;
pub(crate) use source::{Source, is_pipe, refuse_terminal, required_sensor, unknown_sensor};
pub(crate) use summed::{SummedCapture, describe_sum, sum_by_itself};

use crate::error::fields::flags_in_text;
use crate::report::Report;
use qudi_io::capture::Capture;

/// Prints on standard error what the user should know about a capture.
pub(crate) fn remarks(capture: &Capture, report: &Report) {
    for remark in &capture.info().notes {
        report.remark(&format!("note: {}", flags_in_text(remark)));
    }
}
