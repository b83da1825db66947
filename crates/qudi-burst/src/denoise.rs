//! Denoising of single images.

pub(crate) mod block_statistics;
pub(crate) mod bm3d;
pub(crate) mod stabilized;
pub(crate) mod vst;
