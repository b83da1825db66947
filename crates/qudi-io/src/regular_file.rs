//! Opening files that must be regular ones: a pipe or a device could keep a reader waiting for ever.

use qudi_core::{Result, SimError};
use std::fs::File;
use std::path::Path;

/// Refuses what is neither missing nor a regular file, such as a pipe, a device or a folder.
pub(crate) fn require(path: &Path) -> Result<()> {
    match std::fs::metadata(path) {
        Ok(found) if !found.is_file() => Err(SimError::data(
            "not a regular file",
            path,
            "store its data in a file first, and name that",
        )),
        Ok(_) => Ok(()),
        Err(e) => Err(SimError::io("open", path, e)),
    }
}

/// Opens a regular file.
pub(crate) fn open(path: &Path) -> Result<File> {
    require(path)?;
    File::open(path).map_err(|e| SimError::io("open", path, e))
}
