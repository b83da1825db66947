//! Merging aligned frames.

pub(crate) mod blocks;
pub(crate) mod cubic;
pub(crate) mod dft;
pub(crate) mod hot;
pub(crate) mod wiener;
