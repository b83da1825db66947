//! Bursts on disk: packed bits, counts in `.npy`, TIFF stacks, PNG folders.

mod bits;
mod png_folder;
mod writer;

pub use bits::{pack_row, unpack_row};
pub use writer::{BurstFormat, BurstWriter, write_npy_stream};
