//! Options of `qudi look`.

use crate::args::Reading;
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// A first look at a capture, in seconds: what it is, its light, a mean, one instant restored
///
/// Prints what `qudi info` does and what `qudi restore` would do, and writes one page: the mean of the
/// capture next to one instant of it, aligned and merged.
#[derive(Debug, ClapArgs)]
pub(crate) struct Look {
    /// The capture: a file or a folder in any format
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Page to write: .html, or .png for the pictures alone [default: NAME-look.html in this folder]
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) output: Option<PathBuf>,
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}
