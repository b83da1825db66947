//! Options of `qudi convert`.

use crate::args::Reading;
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Copy a capture from any format into one that everything reads
///
/// Pixels stay as they are unless --mask or --dcr ask for repair. With --sum N, N frames are
/// summed into each output frame. OUT is an .npy file (binary frames are packed as photoncube and
/// visionsim do), a multi-page .tif, or a folder of PNG (no extension), with a record next to it.
#[derive(Debug, ClapArgs)]
pub(crate) struct Convert {
    /// The capture: a file or a folder, or - for a pipe of .npy or raw frames
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Where it goes
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: PathBuf,
    /// Write binary .npy bursts with one byte per pixel
    #[arg(long)]
    pub(crate) unpacked: bool,
    #[command(flatten)]
    pub(crate) reading: Reading,
}
