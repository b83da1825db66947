//! Files that a command writes when its work is done.

use crate::error::Result;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use std::io::Write;
use std::path::Path;

/// A file that is opened before the work and written after it.
///
/// A place that cannot be written is refused at once, and not after hours. Dropped without [`Output::write`],
/// it leaves nothing behind.
#[derive(Debug)]
pub(crate) struct Output(Option<PendingFile>);

impl Output {
    /// Opens the file; no path, no file.
    pub(crate) fn open(path: Option<&Path>, overwrite: Overwrite) -> Result<Self> {
        Ok(Self(path.map(|path| PendingFile::create(path, overwrite)).transpose()?))
    }

    /// Writes what `content` makes, if there is a file.
    pub(crate) fn write<T: AsRef<[u8]>>(self, content: impl FnOnce() -> Result<T>) -> Result<()> {
        let Some(mut file) = self.0 else { return Ok(()) };
        let content = content()?;
        file.write_all(content.as_ref()).map_err(|e| file.fault(e))?;
        Ok(file.finish()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scratch(name: &str) -> std::path::PathBuf {
        let folder =
            std::env::temp_dir().join(format!("qudi-output-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap_or_else(|e| panic!("{e}"));
        folder
    }

    #[test]
    fn refuses_impossible_place_before_the_work() {
        let path = Path::new("/no/such/folder/table.csv");
        assert!(Output::open(Some(path), Overwrite::Yes).is_err());
    }

    #[test]
    fn leaves_nothing_behind_when_dropped() {
        let folder = scratch("dropped");
        let path = folder.join("table.csv");
        drop(Output::open(Some(&path), Overwrite::No));
        assert_eq!(std::fs::read_dir(&folder).map(Iterator::count).ok(), Some(0));
    }

    #[test]
    fn writes_file_when_work_is_done() {
        let folder = scratch("written");
        let path = folder.join("table.csv");
        let written =
            Output::open(Some(&path), Overwrite::Yes).and_then(|file| file.write(|| Ok("a,b")));
        assert!(written.is_ok());
        assert_eq!(std::fs::read_to_string(&path).ok().as_deref(), Some("a,b"));
    }

    #[test]
    fn makes_no_content_without_a_path() {
        let unused = Output::open(None, Overwrite::No);
        let written =
            unused.and_then(|none| none.write(|| -> Result<&str> { panic!("not asked for") }));
        assert!(written.is_ok());
    }
}
