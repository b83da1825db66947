//! Files that appear only when finished; dropped before `finish`, they leave nothing behind.

use super::unnamed_file;
use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

pub use super::atomic_folder::{OwnFolder, PendingFolder};
pub use super::unfinished_folder::UnfinishedFolder;

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
    writer: BufWriter<Temporary>,
    path: PathBuf,
    overwrite: Overwrite,
}

/// A file that is gone if its name does not become the result's.
#[derive(Debug)]
enum Temporary {
    /// Gone with the process, however it ends.
    Unnamed(File),
    /// Gone when dropped.
    Named(NamedTempFile),
}

impl Temporary {
    fn create(folder: &Path) -> std::io::Result<Self> {
        match unnamed_file::create(folder) {
            Some(file) => Ok(Self::Unnamed(file)),
            None => names().tempfile_in(folder).map(Self::Named),
        }
    }

    fn file(&mut self) -> &mut File {
        match self {
            Self::Unnamed(file) => file,
            Self::Named(file) => file.as_file_mut(),
        }
    }

    /// Gives the file its name; a file that took the name in the meantime is kept unless it is overwritten.
    fn persist(self, path: &Path, overwrite: Overwrite) -> std::io::Result<()> {
        let named = match self {
            Self::Unnamed(file) if overwrite == Overwrite::No => {
                return unnamed_file::link(&file, path);
            }
            Self::Unnamed(file) => {
                let link = |path: &Path| unnamed_file::link(&file, path);
                let ((), name) = names().make_in(parent(path), link)?.into_parts();
                return Ok(name.persist(path)?);
            }
            Self::Named(file) => file,
        };
        let kept = match overwrite {
            Overwrite::Yes => named.persist(path),
            Overwrite::No => named.persist_noclobber(path),
        };
        Ok(kept.map(drop)?)
    }
}

impl Write for Temporary {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.file().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.file().flush()
    }
}

impl Seek for Temporary {
    fn seek(&mut self, position: SeekFrom) -> std::io::Result<u64> {
        self.file().seek(position)
    }
}

/// Returns names for temporary files that nobody can foretell.
fn names() -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".qudi-").suffix(".tmp");
    // Temporary files are private by default; results get the permissions of any new file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder
}

/// Returns the folder of `path`, `.` for a bare name.
pub(super) fn parent(path: &Path) -> &Path {
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
        let file =
            Temporary::create(parent(path)).map_err(|e| Error::io("create the output", path, e))?;
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
        Ok(self.writer.get_mut().file())
    }

    /// Flushes to disk and gives the file its name.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full or the folder is gone.
    pub fn finish(mut self) -> Result<()> {
        let synced = self.flushed().and_then(|file| file.sync_all());
        synced.map_err(|e| self.fault(e))?;
        self.finish_unsynced()
    }

    /// Gives the file its name, without waiting for the disk: for one of many files that can be made again.
    ///
    /// # Errors
    /// [`Error::Io`] if the disk is full or the folder is gone.
    pub fn finish_unsynced(self) -> Result<()> {
        let path = self.path;
        let fault = |e: std::io::Error| Error::io("write", &path, e);
        let file = self.writer.into_inner().map_err(|e| fault(e.into_error()))?;
        file.persist(&path, self.overwrite).map_err(fault)
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

impl Seek for PendingFile {
    fn seek(&mut self, position: SeekFrom) -> std::io::Result<u64> {
        self.writer.seek(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names_in(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect()
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn unfinished_files_have_no_name_that_a_killed_process_could_leave() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let mut file = PendingFile::create(&path, Overwrite::No).unwrap();
        file.write_all(b"half").unwrap();
        file.flushed().unwrap();
        assert!(names_in(folder.path()).is_empty());
        file.finish().unwrap();
        assert_eq!(names_in(folder.path()), ["a.npy"]);
        PendingFile::write_whole(&path, b"other", Overwrite::Yes).unwrap();
        assert_eq!(
            (names_in(folder.path()).len(), std::fs::read(&path).unwrap()),
            (1, b"other".into())
        );
    }

    #[test]
    fn a_file_that_took_the_name_meanwhile_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let file = PendingFile::create(&path, Overwrite::No).unwrap();
        std::fs::write(&path, "theirs").unwrap();
        assert!(file.finish().is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"theirs");
    }
}
