//! What a command reads and writes: no output is an input, and no two outputs are one, whatever `--force`
//! says.

use crate::error::{CliError, Result};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Files and folders of one command.
#[derive(Debug, Default)]
pub(crate) struct Places {
    inputs: Vec<PathBuf>,
    outputs: Vec<PathBuf>,
}

/// A file or folder whatever it is called: through links, and by other names of the same file.
#[derive(Debug, PartialEq, Eq)]
struct Identity {
    path: PathBuf,
    /// Device and number of the file, where it exists and the system has such numbers.
    file: Option<(u64, u64)>,
}

impl Identity {
    fn of(path: &Path) -> Self {
        Self { path: resolved(path), file: number(path) }
    }

    fn is(&self, other: &Self) -> bool {
        self.path == other.path || self.file.is_some() && self.file == other.file
    }
}

impl Places {
    /// Adds what the command reads; `-` and names that are no path are left out.
    pub(crate) fn reads<P: AsRef<Path>>(mut self, paths: impl IntoIterator<Item = P>) -> Self {
        self.inputs.extend(
            paths.into_iter().map(|path| path.as_ref().to_owned()).filter(|path| is_path(path)),
        );
        self
    }

    /// Adds a capture or clip with its record.
    pub(crate) fn reads_burst(self, path: &Path) -> Self {
        let mut record = OsString::from(path);
        record.push(".json");
        self.reads([path, Path::new(&record)])
    }

    /// Adds what the command writes.
    pub(crate) fn writes<P: AsRef<Path>>(mut self, paths: impl IntoIterator<Item = P>) -> Self {
        self.outputs.extend(
            paths.into_iter().map(|path| path.as_ref().to_owned()).filter(|path| is_path(path)),
        );
        self
    }

    /// Refuses outputs that are, hold, or lie among inputs, outputs that are one, and places where no file
    /// can be.
    ///
    /// # Errors
    /// A [`CliError`] that names the output and what it would destroy.
    pub(crate) fn check(&self) -> Result<()> {
        let inputs: Vec<_> = self.inputs.iter().filter(|path| path.exists()).collect();
        for (n, output) in self.outputs.iter().enumerate() {
            refuse_impossible(output)?;
            let own = Identity::of(output);
            for input in &inputs {
                let other = Identity::of(input);
                let exists = output.symlink_metadata().is_ok();
                let what = if own.is(&other) {
                    "the output is an input".to_owned()
                } else if other.path.starts_with(&own.path) && exists {
                    format!("the output holds the input {}", input.display())
                } else if own.path.starts_with(&other.path) && exists {
                    format!("the output is part of the input {}", input.display())
                } else {
                    continue;
                };
                return Err(CliError::new(what, output.display(), "choose another name"));
            }
            for other in &self.outputs[..n] {
                let second = Identity::of(other);
                let what = if own.is(&second) {
                    "two outputs are one file"
                } else if own.path.starts_with(&second.path) || second.path.starts_with(&own.path) {
                    "one output lies in another"
                } else {
                    continue;
                };
                return Err(CliError::new(what, output.display(), "give them names of their own"));
            }
        }
        Ok(())
    }
}

/// Refuses devices, pipes and folders that do not exist, before the work and not after it.
fn refuse_impossible(output: &Path) -> Result<()> {
    if std::fs::metadata(output).is_ok_and(|kind| !kind.is_file() && !kind.is_dir()) {
        return Err(CliError::new("not a regular file", output.display(), "name a file to write"));
    }
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty());
    match parent {
        Some(parent) if !parent.is_dir() => Err(CliError::new(
            format!("cannot create the output: {} is not a folder", parent.display()),
            output.display(),
            "make the folder first, or choose another",
        )),
        _ => Ok(()),
    }
}

fn is_path(path: &Path) -> bool {
    !path.as_os_str().is_empty() && path.as_os_str() != "-"
}

/// Follows links; in a path that does not exist yet, the links of its folder.
fn resolved(path: &Path) -> PathBuf {
    if let Ok(path) = path.canonicalize() {
        return path;
    }
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new(".")).canonicalize();
    match (folder, path.file_name()) {
        (Ok(folder), Some(name)) => folder.join(name),
        _ => std::path::absolute(path).unwrap_or_else(|_| path.to_owned()),
    }
}

#[cfg(unix)]
fn number(path: &Path) -> Option<(u64, u64)> {
    use std::os::unix::fs::MetadataExt;
    let metadata = std::fs::metadata(path).ok()?;
    Some((metadata.dev(), metadata.ino()))
}

#[cfg(not(unix))]
fn number(_: &Path) -> Option<(u64, u64)> {
    None
}
