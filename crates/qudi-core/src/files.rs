//! Files of any kind: written whole or not at all, read within limits, NumPy arrays, names in natural order,
//! ffmpeg.

pub mod atomic_file;
mod atomic_folder;
mod ffmpeg;
pub mod natural_order;
pub mod npy;
pub mod regular_file;
mod unfinished_folder;
mod unnamed_file;

pub use ffmpeg::ffmpeg;
