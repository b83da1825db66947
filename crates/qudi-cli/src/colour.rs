//! Colours of captures: white balance, rendering, files, and their names in DNG.

mod behind_filter;
mod dng;
mod encoding;
mod rendering;
mod white_balance;

pub(crate) use behind_filter::behind_filter;
pub(crate) use dng::dng_tags;
pub(crate) use encoding::{encoded, is_linear};
pub(crate) use rendering::Rendering;
pub(crate) use white_balance::Gains;
