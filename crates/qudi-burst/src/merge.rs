//! Merging of aligned frames.

pub(crate) mod blocks;
pub(crate) mod cubic;
mod dft16;
pub(crate) mod hot_pixels;
pub(crate) mod merged_frame;
pub(crate) mod wiener;
