//! Descriptions of captures: what files say ([`CaptureInfo`]), and what the user says ([`ReadOptions`]).

mod format_options;
mod info;
mod options;
mod pedestal;

pub use format_options::FormatOption;
pub(crate) use format_options::{refuse_others, refuse_packing};
pub(crate) use info::RECORD;
pub use info::{CaptureInfo, Certainty, Packing};
pub use options::{Axes, BitOrder, Crop, MaskChoice, Orientation, PackAxis, ReadOptions};
pub(crate) use pedestal::{keep_pedestal, with_pedestal};
