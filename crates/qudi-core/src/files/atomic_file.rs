//! Files and folders that appear only when finished; dropped before `finish`, they leave nothing behind.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use tempfile::{NamedTempFile, TempDir};

/// What to do if the name is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overwrite {
    /// Refuse.
    No,
    /// Replace a file, or a folder if this program wrote everything in it.
    Yes,
}

/// A file that appears under its name only when finished.
#[derive(Debug)]
pub struct PendingFile {
    writer: BufWriter<NamedTempFile>,
    path: PathBuf,
    overwrite: Overwrite,
}

/// Returns the folder of `path`, `.` for a bare name.
fn parent(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Refuses a name that is taken, before any work is done for it.
///
/// # Errors
/// [`Error::Exists`] if it may not be overwritten.
pub fn refuse_taken(path: &Path, overwrite: Overwrite) -> Result<()> {
    if overwrite == Overwrite::No && path.symlink_metadata().is_ok() {
        return Err(Error::Exists { path: path.to_owned() });
    }
    Ok(())
}

impl PendingFile {
    /// Creates a temporary file in the folder of `path`.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or the folder cannot be written.
    pub fn create(path: &Path, overwrite: Overwrite) -> Result<Self> {
        refuse_taken(path, overwrite)?;
        if path.is_dir() {
            return Err(Error::data("the output is a folder", path, "name a file"));
        }
        let mut builder = tempfile::Builder::new();
        builder.prefix(".qudi-").suffix(".tmp");
        // Temporary files are private by default; results get the permissions of any new file.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let file = builder
            .tempfile_in(parent(path))
            .map_err(|e| Error::io("create the output", path, e))?;
        Ok(Self {
            writer: BufWriter::with_capacity(1 << 18, file),
            path: path.to_owned(),
            overwrite,
        })
    }

    /// Writes `bytes` to a new file.
    ///
    /// # Errors
    /// [`Error`] if the name is taken, or the file cannot be written.
    pub fn write_whole(path: &Path, bytes: &[u8], overwrite: Overwrite) -> Result<()> {
        let mut file = Self::create(path, overwrite)?;
        file.write_all(bytes).map_err(|e| file.fault(e))?;
        file.finish()
    }

    /// Returns the name after [`Self::finish`].
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Wraps an error of writing into this file.
    pub fn fault(&self, e: std::io::Error) -> Error {
        Error::io("write", &self.path, e)
    }

    /// Flushes everything written so far and returns the open file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn flushed(&mut self) -> std::io::Result<&mut File> {
        self.writer.flush()?;
        Ok(self.writer.get_mut().as_file_mut())
    }

    /// Flushes to disk and gives the file its name.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full or the folder is gone.
    pub fn finish(self) -> Result<()> {
        let path = self.path;
        let fault = |e: std::io::Error| Error::io("write", &path, e);
        let file = self.writer.into_inner().map_err(|e| fault(e.into_error()))?;
        file.as_file().sync_all().map_err(fault)?;
        // A file that took the name in the meantime is kept.
        let named = match self.overwrite {
            Overwrite::Yes => file.persist(&path),
            Overwrite::No => file.persist_noclobber(&path),
        };
        named.map(drop).map_err(|e| fault(e.error))
    }
}

impl Write for PendingFile {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.writer.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.writer.flush()
    }
}

impl std::io::Seek for PendingFile {
    fn seek(&mut self, position: std::io::SeekFrom) -> std::io::Result<u64> {
        self.writer.seek(position)
    }
}

/// Describes the folders that a writer makes, so that no other is replaced.
#[derive(Clone, Copy, Debug)]
pub struct OwnFolder {
    /// A file that every such folder holds.
    pub marker: &'static str,
    /// Returns true for names of files that are written into such folders.
    pub is_own_file: fn(&str) -> bool,
}

impl OwnFolder {
    /// Refuses a folder at `path` that holds anything else. An empty one is fine.
    ///
    /// # Errors
    /// [`Error`] that names a foreign file.
    fn check(&self, path: &Path) -> Result<()> {
        let list = |e| Error::io("list the output", path, e);
        let help = "choose another name, or remove it yourself";
        if !path.is_dir() {
            return Err(Error::data("the output exists and is not a folder", path, help));
        }
        let mut marked = false;
        let mut entries = 0;
        for entry in std::fs::read_dir(path).map_err(list)? {
            let entry = entry.map_err(list)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let is_file = entry.file_type().map_err(list)?.is_file();
            if !is_file || !(name == self.marker || (self.is_own_file)(&name)) {
                return Err(Error::data(
                    format!("the output holds `{name}`, which this program did not write"),
                    path,
                    "choose another name, or move that file away",
                ));
            }
            marked |= name == self.marker;
            entries += 1;
        }
        if marked || entries == 0 {
            return Ok(());
        }
        let marker = self.marker;
        Err(Error::data(
            format!("the output exists and was not made by this program (no {marker} in it)"),
            path,
            help,
        ))
    }
}

/// A folder that appears under its name only when finished.
#[derive(Debug)]
pub struct PendingFolder {
    folder: TempDir,
    path: PathBuf,
    overwrite: Overwrite,
    own: OwnFolder,
}

impl PendingFolder {
    /// Creates a temporary folder in the parent of `path`. An existing folder is overwritten only if it is
    /// empty or all its files are of `own`.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or the parent folder cannot be written.
    pub fn create(path: &Path, overwrite: Overwrite, own: OwnFolder) -> Result<Self> {
        refuse_taken(path, overwrite)?;
        if path.symlink_metadata().is_ok() {
            own.check(path)?;
        }
        let mut builder = tempfile::Builder::new();
        builder.prefix(".qudi-").suffix(".tmp");
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
        let folder = builder
            .tempdir_in(parent(path))
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

    /// Gives the folder its name.
    ///
    /// # Errors
    /// [`Error::Io`] if that fails.
    pub fn finish(self) -> Result<()> {
        let fault = |e| Error::io("rename the finished folder to", &self.path, e);
        if self.overwrite == Overwrite::Yes && self.path.is_dir() {
            // Another program may have written to it in the meantime.
            self.own.check(&self.path)?;
            // The old folder is renamed first, and renamed back if the new one cannot replace it.
            let aside = self.folder.path().with_extension("old");
            std::fs::rename(&self.path, &aside).map_err(fault)?;
            if let Err(e) = std::fs::rename(self.folder.path(), &self.path) {
                let _ = std::fs::rename(&aside, &self.path);
                return Err(fault(e));
            }
            std::fs::remove_dir_all(&aside).map_err(fault)?;
        } else {
            std::fs::rename(self.folder.path(), &self.path).map_err(fault)?;
        }
        // The temporary name is gone; there is nothing left to clean up.
        let _ = self.folder.keep();
        Ok(())
    }
}
