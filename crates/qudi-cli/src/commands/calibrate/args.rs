//! Options of `qudi calibrate`.

use crate::args::{Reading, number};
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Measure dark rates, hot pixels and read noise from a capture with the shutter closed
///
/// Writes a sensor file and two maps next to it (NAME.dark.npy, NAME.bad.npy), used from then on by
/// --sensor NAME.toml or --dcr NAME.toml.
#[derive(Debug, ClapArgs)]
pub(crate) struct Calibrate {
    /// The dark capture
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// The sensor file to write
    #[arg(short, long, value_name = "TOML", value_hint = ValueHint::FilePath)]
    pub(crate) output: PathBuf,
    /// Sensor to start from: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Gain of this capture in DN per electron, for sensors whose gain follows the light
    #[arg(long, value_name = "DN/E-", allow_negative_numbers = true, value_parser = number::real(number::GAIN))]
    pub(crate) gain: Option<f64>,
    /// Dark rate beyond which a pixel is hot: per frame, or per second as in 100/s [default: 10 x the median]
    #[arg(long, value_name = "RATE")]
    pub(crate) hot: Option<String>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}
