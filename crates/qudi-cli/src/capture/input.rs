//! What a capture is read from: a file, a pipe, or what a calling program holds.

use qudi_core::Result;
use qudi_core::sensor::Sensor;
use qudi_io::capture::Capture;
use qudi_io::description::ReadOptions;
use std::path::Path;
use std::sync::Arc;

/// A function that opens a capture.
type Open = dyn Fn(&ReadOptions, Option<&Sensor>) -> Result<Capture> + Send + Sync;

/// What a capture is read from. Files and arrays may be opened several times, pipes once.
#[derive(Clone)]
pub struct Input {
    is_pipe: bool,
    open: Arc<Open>,
}

impl std::fmt::Debug for Input {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Input").field("is_pipe", &self.is_pipe).finish_non_exhaustive()
    }
}

impl Input {
    /// Creates an input that `open` opens, whose frames can be read in any order.
    pub fn array(
        open: impl Fn(&ReadOptions, Option<&Sensor>) -> Result<Capture> + Send + Sync + 'static,
    ) -> Self {
        Self { is_pipe: false, open: Arc::new(open) }
    }

    /// Creates an input that `open` opens, whose frames come once, in order.
    pub fn pipe(
        open: impl Fn(&ReadOptions, Option<&Sensor>) -> Result<Capture> + Send + Sync + 'static,
    ) -> Self {
        Self { is_pipe: true, open: Arc::new(open) }
    }

    /// Creates the input for a file or folder; none stands for standard input.
    pub(crate) fn at(path: Option<&Path>) -> Self {
        match path.map(Path::to_owned) {
            Some(path) => Self::array(move |options, sensor| Capture::open(&path, options, sensor)),
            None => {
                Self::pipe(|options, sensor| Capture::from_pipe(std::io::stdin(), options, sensor))
            }
        }
    }

    /// Returns true if its frames come once.
    pub(crate) fn is_pipe(&self) -> bool {
        self.is_pipe
    }

    /// Opens the capture.
    pub(crate) fn open(&self, options: &ReadOptions, sensor: Option<&Sensor>) -> Result<Capture> {
        (self.open)(options, sensor)
    }
}
