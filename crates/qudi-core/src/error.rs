//! Errors in three parts: what happened, where, and what to do about it.

pub mod nearest;

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

/// Shorthand for results of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Every error of this crate. [`Error::place`] says where, [`Error::help`] what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused.
    #[error("cannot {action}: {source}")]
    Io {
        /// What was tried, as in "read the header".
        action: String,
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A file does not hold what it should.
    #[error("{what}")]
    Data {
        /// What is wrong, with both numbers.
        what: String,
        /// The file.
        path: PathBuf,
        /// What to do about it.
        help: String,
    },
    /// A sensor that cannot exist.
    #[error("impossible sensor: {what}")]
    Sensor {
        /// Which parameter, its value, and the range.
        what: String,
        /// The sensor's name or file.
        place: String,
        /// What to do about it.
        help: String,
    },
    /// A capture that the named sensor cannot have taken.
    #[error("{what}")]
    Mismatch {
        /// What does not fit, with both numbers.
        what: String,
        /// The capture or the option it concerns.
        place: String,
        /// What to do about it.
        help: String,
    },
    /// A request that contradicts itself or the data.
    #[error("{what}")]
    Request {
        /// What does not fit.
        what: String,
        /// The option or the input it concerns.
        place: String,
        /// What to do about it.
        help: String,
    },
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
}

impl Error {
    /// Wraps an error of the operating system with the action in words.
    pub fn io(action: impl Into<String>, path: &Path, source: io::Error) -> Self {
        Self::Io { action: action.into(), path: path.to_owned(), source }
    }

    /// Creates the error for a malformed or unsuitable file.
    pub fn data(what: impl Into<String>, path: &Path, help: impl Into<String>) -> Self {
        Self::Data { what: what.into(), path: path.to_owned(), help: help.into() }
    }

    /// Creates the error for a request that cannot be met.
    pub fn request(what: impl Into<String>, place: impl Display, help: impl Into<String>) -> Self {
        Self::Request { what: what.into(), place: place.to_string(), help: help.into() }
    }

    /// Creates the error for a capture that the named sensor cannot have taken.
    pub fn mismatch(what: impl Into<String>, place: impl Display, help: impl Into<String>) -> Self {
        Self::Mismatch { what: what.into(), place: place.to_string(), help: help.into() }
    }

    /// Returns the file, sensor or option that the error concerns.
    pub fn place(&self) -> Option<String> {
        match self {
            Self::Io { path, .. } | Self::Data { path, .. } => Some(path.display().to_string()),
            Self::Sensor { place, .. }
            | Self::Mismatch { place, .. }
            | Self::Request { place, .. } => Some(place.clone()),
            Self::Interrupted => None,
        }
    }

    /// Returns what to do about it.
    pub fn help(&self) -> Option<String> {
        match self {
            Self::Io { source, .. } => Some(io_help(source.kind()).to_owned()),
            Self::Data { help, .. }
            | Self::Sensor { help, .. }
            | Self::Mismatch { help, .. }
            | Self::Request { help, .. } => Some(help.clone()),
            Self::Interrupted => None,
        }
    }
}

fn io_help(kind: io::ErrorKind) -> &'static str {
    match kind {
        io::ErrorKind::NotFound => "check the name; relative paths start at the current folder",
        io::ErrorKind::PermissionDenied => "check the permissions of the file and of its folder",
        io::ErrorKind::StorageFull => "free some space, or write to another disk",
        io::ErrorKind::IsADirectory => "name a file, not a folder",
        io::ErrorKind::UnexpectedEof => "the file ends too early: copy or export it again",
        _ => "the system gave this reason; check the path and the device it is on",
    }
}
