//! Locks that keep two runs from writing the same frames. The system releases them when a process ends, for
//! whatever reason.

use qudi_core::{Error, Result};
use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};

/// The share of the work that a run does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Share {
    /// All frames.
    Whole,
    /// One of several parts that run at the same time.
    Part {
        /// Number of the part, from 1.
        number: u64,
        /// Number of parts.
        of: u64,
    },
}

/// The lock of a folder, held until it is dropped.
#[derive(Debug)]
pub struct FolderLock {
    _folder: Option<File>,
    /// Lock of a part, and its file, which is removed afterwards.
    part: Option<(File, PathBuf)>,
}

impl FolderLock {
    /// Locks the folder at `path`: alone for a whole run, together with other parts for a part.
    ///
    /// # Errors
    /// [`Error::Data`] if another run holds it.
    pub fn take(path: &Path, share: Share) -> Result<Self> {
        let folder = handle(path);
        let held = match share {
            Share::Whole => folder.as_ref().map(File::try_lock),
            Share::Part { .. } => folder.as_ref().map(File::try_lock_shared),
        };
        check(held, path, "another run is writing into this folder")?;
        let Share::Part { number, of } = share else {
            return Ok(Self { _folder: folder, part: None });
        };
        let file = path.join(format!(".part-{number}-of-{of}.lock"));
        if file.is_symlink() {
            let help = "remove the link, or choose another folder";
            return Err(Error::data("a link lies where the lock of a part belongs", &file, help));
        }
        let part = OpenOptions::new().create(true).append(true).open(&file);
        let part = part.map_err(|e| Error::io("create the lock", &file, e))?;
        let what = format!("another run is at work on part {number} of {of} of this folder");
        check(Some(part.try_lock()), path, &what)?;
        Ok(Self { _folder: folder, part: Some((part, file)) })
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        if let Some((_, file)) = &self.part {
            let _ = std::fs::remove_file(file);
        }
    }
}

/// Opens the folder itself where folders can be opened, or else a hidden file in it.
fn handle(path: &Path) -> Option<File> {
    if cfg!(unix) {
        File::open(path).ok()
    } else {
        OpenOptions::new().create(true).append(true).open(path.join(".lock")).ok()
    }
}

/// Refuses a lock that another process holds. On file systems without locks nothing is refused.
fn check(
    held: Option<std::result::Result<(), TryLockError>>,
    path: &Path,
    what: &str,
) -> Result<()> {
    match held {
        Some(Err(TryLockError::WouldBlock)) => {
            Err(Error::data(what, path, "wait until it is done, or choose another folder"))
        }
        _ => Ok(()),
    }
}
