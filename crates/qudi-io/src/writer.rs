//! Files written whole or not at all: under a temporary name, renamed when complete.

mod array;
mod burst;
mod clip;
mod frame_name;
mod gif;
mod mp4;
mod picture;
mod tiff_stack;

pub use array::ArrayWriter;
pub use burst::{BurstFormat, BurstWriter, beside, pack_row, unpack_row, write_npy_stream};
pub use clip::{ClipWriter, Planes};
pub(crate) use clip::{encode_colour_png16, encode_png16};
pub(crate) use frame_name::{frame_name, is_frame_below, is_frame_name};
pub use gif::GifWriter;
pub use mp4::Mp4Writer;
pub use picture::Picture;
pub use tiff_stack::TiffSamples;
pub(crate) use tiff_stack::TiffStack;
