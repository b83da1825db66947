//! Options of `qudi completions` and `qudi man`.

use clap::Args as ClapArgs;
use clap_complete::Shell;
use std::path::PathBuf;

/// Print a completion script for a shell
#[derive(Debug, ClapArgs)]
pub(crate) struct Completions {
    /// Which shell
    pub(crate) shell: Shell,
}

/// Write the manual pages
#[derive(Debug, ClapArgs)]
pub(crate) struct Man {
    /// Folder for the pages [default: the main page on standard output]
    pub(crate) folder: Option<PathBuf>,
}
