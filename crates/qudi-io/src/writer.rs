//! Files written whole or not at all: under a temporary name, renamed when complete.

mod array;
mod frames;
mod gif_preview;
mod mp4;
mod picture;
mod tiff_stack;

pub use array::ArrayWriter;
pub use frames::FramesWriter;
pub(crate) use frames::save_png16;
pub use gif_preview::GifPreview;
pub use mp4::Mp4;
pub use picture::Picture;
pub use tiff_stack::TiffSamples;
pub(crate) use tiff_stack::TiffStack;
