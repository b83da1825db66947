//! Native frames of a capture: packed bits or samples, over files, streams and pipes.

pub(crate) mod bit_sums;
pub(crate) mod chain;
pub(crate) mod channel_pages;
pub(crate) mod checksum;
mod count_frames;
pub(crate) mod depth;
pub(crate) mod every_nth;
pub(crate) mod frame_bytes;
pub(crate) mod levels;
pub(crate) mod memory;
pub(crate) mod packed;
pub(crate) mod pipe;
pub(crate) mod reordered;
pub(crate) mod samples;
pub(crate) mod shifted;

pub use count_frames::CountFrames;
