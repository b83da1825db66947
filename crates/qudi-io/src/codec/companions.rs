//! Files that are read with a capture.

use super::visionsim;
use crate::writer::beside;
use std::path::{Path, PathBuf};

/// Returns the capture at `path`, its record, and files elsewhere that it consists of, whether or not they
/// exist.
pub fn files_of(path: &Path) -> Vec<PathBuf> {
    let mut files = vec![path.to_owned(), beside(path)];
    files.extend(visionsim::files_of(path));
    files
}
