//! Restoring a capture window by window, to frames in a folder or anywhere else.

mod changed_settings;
mod frame_folder;
mod inputs;
mod instants;
mod lock;
mod run;

pub use frame_folder::{FolderRun, FrameFolder, MANIFEST};
pub use inputs::{Fingerprint, Inputs};
pub use instants::{Instants, Schedule};
pub use lock::{FolderLock, Share};
pub use run::{RestoreSink, run};
