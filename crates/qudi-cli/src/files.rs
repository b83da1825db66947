//! Small files of the user: regular, and not larger than such files are.

use crate::error::{Fault, Result};
use qudi_core::SimError;
use std::path::Path;

/// Refuses pipes, devices and folders, which reading would wait for or never end with.
pub(crate) fn regular(path: &Path, what: &str) -> Result<u64> {
    let read = |e| SimError::io(format!("read {what}"), path, e);
    let metadata = std::fs::metadata(path).map_err(read)?;
    if !metadata.is_file() {
        let kind = if metadata.is_dir() { "a folder" } else { "not a regular file" };
        return Err(Fault::new(
            format!("{kind}, where {what} should be"),
            path.display(),
            "name a file",
        ));
    }
    Ok(metadata.len())
}

/// The text of a file of at most `limit` bytes; `what` names it in errors.
pub(crate) fn read_small(path: &Path, what: &str, limit: u64, help: &str) -> Result<String> {
    let length = regular(path, what)?;
    if length > limit {
        let text = format!("{length} bytes are over the limit of {limit} for {what}");
        return Err(Fault::new(text, path.display(), help));
    }
    let failed =
        |e: std::io::Error| Fault::new(format!("cannot read {what}: {e}"), path.display(), help);
    std::fs::read_to_string(path).map_err(failed)
}
