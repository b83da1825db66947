//! Folders that appear only when finished, with a manifest of what this program wrote into them.

use super::atomic_file::{Overwrite, parent, refuse_taken};
use super::unfinished_folder::UnfinishedFolder;
use crate::error::{Error, Result};
use crate::limits::RECORD_BYTES;
use crate::regular_file::read_limited;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The folders that a writer makes, known by their manifest, so that no other is replaced.
#[derive(Clone, Copy, Debug)]
pub struct OwnFolder {
    /// Name of the manifest: a JSON document whose `program` is this one.
    pub manifest: &'static str,
    /// Returns true for names of files that a manifest says were written with it.
    pub is_named: fn(&Value, &str) -> bool,
}

impl OwnFolder {
    /// Reads the manifest of a folder; none if this program wrote none there.
    pub fn read(&self, path: &Path) -> Option<Value> {
        let bytes =
            read_limited(&path.join(self.manifest), RECORD_BYTES, "read the manifest").ok()?;
        let manifest: Value = serde_json::from_slice(&bytes).ok()?;
        let program = manifest["program"].as_str()?;
        program.starts_with("qudi ").then_some(manifest)
    }

    /// Lists the files of a folder, all of which this program wrote. An empty folder is fine.
    ///
    /// # Errors
    /// [`Error`] that names a foreign file.
    fn files(&self, path: &Path) -> Result<Vec<PathBuf>> {
        let list = |e| Error::io("list the output", path, e);
        let help = "choose another name, or remove it yourself";
        // A link to a folder is no folder of ours.
        if !path.symlink_metadata().map_err(list)?.is_dir() {
            return Err(Error::data("the output exists and is not a folder", path, help));
        }
        let manifest = self.read(path);
        let mut files = Vec::new();
        for entry in std::fs::read_dir(path).map_err(list)? {
            let entry = entry.map_err(list)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let is_file = entry.file_type().map_err(list)?.is_file();
            let is_named = manifest
                .as_ref()
                .is_some_and(|manifest| name == self.manifest || (self.is_named)(manifest, &name));
            if !is_file || !is_named {
                let what = format!(
                    "the output holds `{name}`, which this program did not write (no {} of its own names it)",
                    self.manifest
                );
                return Err(Error::data(what, path, "choose another name, or move it away"));
            }
            files.push(entry.path());
        }
        Ok(files)
    }
}

/// A folder that appears under its name only when finished.
#[derive(Debug)]
pub struct PendingFolder {
    folder: UnfinishedFolder,
    path: PathBuf,
    overwrite: Overwrite,
    own: OwnFolder,
}

impl PendingFolder {
    /// Creates a temporary folder in the parent of `path`. An existing folder is overwritten only if it is
    /// empty or a manifest of `own` names all its files.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or the parent folder cannot be written.
    pub fn create(path: &Path, overwrite: Overwrite, own: OwnFolder) -> Result<Self> {
        refuse_taken(path, overwrite)?;
        if path.symlink_metadata().is_ok() {
            own.files(path)?;
        }
        let folder = UnfinishedFolder::create_in(parent(path))
            .map_err(|e| Error::io("create the output", path, e))?;
        Ok(Self { folder, path: path.to_owned(), overwrite, own })
    }

    /// Returns the path of a file inside, for writing.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Returns the name after [`Self::finish`].
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the manifest, and gives the folder its name.
    ///
    /// # Errors
    /// [`Error::Io`] if that fails.
    pub fn finish(self, manifest: &[u8]) -> Result<()> {
        std::fs::write(self.file(self.own.manifest), manifest)
            .map_err(|e| Error::io("write the manifest of", &self.path, e))?;
        let fault = |e| Error::io("rename the finished folder to", &self.path, e);
        self.folder.unlocked().map_err(fault)?;
        if self.overwrite == Overwrite::Yes && self.path.is_dir() {
            // Another program may have written to it in the meantime.
            let files = self.own.files(&self.path)?;
            // The old folder is renamed first, and renamed back if the new one cannot replace it.
            let aside = self.folder.path().with_extension("old");
            std::fs::rename(&self.path, &aside).map_err(fault)?;
            if let Err(e) = std::fs::rename(self.folder.path(), &self.path) {
                let _ = std::fs::rename(&aside, &self.path);
                return Err(fault(e));
            }
            for file in files {
                let name = file.file_name().unwrap_or_default();
                std::fs::remove_file(aside.join(name)).map_err(fault)?;
            }
            std::fs::remove_dir(&aside).map_err(fault)?;
        } else {
            std::fs::rename(self.folder.path(), &self.path).map_err(fault)?;
        }
        // The temporary name is gone; there is nothing left to clean up.
        self.folder.keep();
        Ok(())
    }
}
