//! Restoring a capture window by window, to frames in a folder or anywhere else.

mod frame_folder;
mod run;

pub use frame_folder::{FrameFolder, MANIFEST};
pub use run::{RestoreSink, run};
