//! Options of `qudi completions` and `qudi man`.

use clap::{Args as ClapArgs, ValueHint};
use clap_complete::Shell;
use std::path::PathBuf;

/// Print a completion script for a shell
#[derive(Debug, ClapArgs)]
pub(crate) struct Completions {
    /// Which shell
    pub(crate) shell: Shell,
}

/// Write the manual pages, and the completion scripts of all shells next to them
#[derive(Debug, ClapArgs)]
pub(crate) struct Man {
    /// Folder for qudi.1, qudi-restore.1, ... and completions/ [default: the main page on standard output]
    #[arg(value_hint = ValueHint::DirPath)]
    pub(crate) folder: Option<PathBuf>,
}
