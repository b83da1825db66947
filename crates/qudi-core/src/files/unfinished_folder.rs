//! Temporary folders of unfinished outputs. The next run in the same place removes the ones of killed runs.

use std::fs::File;
use std::io::{Read, Result, Write};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// File in every such folder, which its process locks: the system unlocks it when the process ends.
const LOCK: &str = ".qudi-lock";

/// Content of the lock, which makes a folder ours.
const OWN: &[u8] = b"an unfinished output of qudi\n";

/// Beginning and end of the folders' names.
const AFFIXES: [&str; 2] = [".qudi-", ".tmp"];

/// A temporary folder that is removed unless it is kept.
#[derive(Debug)]
pub struct UnfinishedFolder {
    folder: TempDir,
    _lock: File,
}

impl UnfinishedFolder {
    /// Creates a folder in `parent`, and removes folders of runs that were killed.
    ///
    /// # Errors
    /// As [`std::fs::create_dir`].
    pub fn create_in(parent: &Path) -> Result<Self> {
        remove_abandoned(parent);
        let [prefix, suffix] = AFFIXES;
        let mut builder = tempfile::Builder::new();
        builder.prefix(prefix).suffix(suffix);
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
        let folder = builder.tempdir_in(parent)?;
        let mut lock = File::create_new(folder.path().join(LOCK))?;
        // Where nothing can be locked, the folder never counts as abandoned: it has no content.
        if lock.try_lock().is_ok() {
            lock.write_all(OWN)?;
        }
        Ok(Self { folder, _lock: lock })
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Removes the lock, so that the folder can get its name, and returns its path.
    ///
    /// # Errors
    /// As [`std::fs::remove_file`].
    pub fn unlocked(&self) -> Result<PathBuf> {
        std::fs::remove_file(self.folder.path().join(LOCK))?;
        Ok(self.folder.path().to_owned())
    }

    /// Keeps what has got another name.
    pub fn keep(self) {
        let _ = self.folder.keep();
    }
}

/// Removes folders whose process has ended, and which hold nothing but files.
fn remove_abandoned(parent: &Path) {
    let Ok(entries) = std::fs::read_dir(parent) else { return };
    let [prefix, suffix] = AFFIXES;
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
        if is_folder && name.starts_with(prefix) && name.ends_with(suffix) {
            let _ = remove_if_abandoned(&entry.path());
        }
    }
}

fn remove_if_abandoned(folder: &Path) -> Result<()> {
    let path = folder.join(LOCK);
    if !path.symlink_metadata()?.is_file() {
        return Ok(());
    }
    let lock = File::open(&path)?;
    let mut content = Vec::new();
    (&lock).take(OWN.len() as u64 + 1).read_to_end(&mut content)?;
    if content != OWN || lock.try_lock().is_err() {
        return Ok(());
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if !entry.file_type()?.is_file() {
            return Ok(());
        }
        files.push(entry.path());
    }
    for file in files {
        std::fs::remove_file(file)?;
    }
    std::fs::remove_dir(folder)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_killed_runs_are_removed_and_no_others() {
        let parent = tempfile::tempdir().unwrap();
        let folder = |name: &str, lock: Option<&[u8]>| {
            let path = parent.path().join(name);
            std::fs::create_dir(&path).unwrap();
            std::fs::write(path.join("frame_000000.png"), b"x").unwrap();
            if let Some(lock) = lock {
                std::fs::write(path.join(LOCK), lock).unwrap();
            }
            path
        };
        let abandoned = folder(".qudi-abc123.tmp", Some(OWN));
        let others = [
            folder(".qudi-other1.tmp", None),
            folder(".qudi-other2.tmp", Some(b"mine")),
            folder("results", Some(OWN)),
            folder(".qudi-nested.tmp", Some(OWN)),
        ];
        std::fs::create_dir(others[3].join("deeper")).unwrap();
        let alive = UnfinishedFolder::create_in(parent.path()).unwrap();
        assert!(!abandoned.exists());
        assert!(others.iter().all(|path| path.join("frame_000000.png").is_file()));
        let next = UnfinishedFolder::create_in(parent.path()).unwrap();
        assert!(alive.path().join(LOCK).is_file(), "its process is alive");
        assert!(!next.unlocked().unwrap().join(LOCK).exists());
    }
}
