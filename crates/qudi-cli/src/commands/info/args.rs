//! Options of `qudi info`.

use crate::args::Reading;
use clap::{ArgGroup, Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Describe anything: captures in any format, bursts, weights, sensors, devices
#[derive(Debug, ClapArgs)]
#[group(skip)]
#[command(group(ArgGroup::new("what").required(true)))]
pub(crate) struct Info {
    /// A capture (file or folder), a burst or its record, weights (.safetensors, .pth, or `weights` for the
    /// built-in ones), a sensor's name or .toml file
    #[arg(group = "what", value_hint = ValueHint::AnyPath)]
    pub(crate) subject: Option<String>,
    /// List the built-in sensors
    #[arg(long, group = "what")]
    pub(crate) sensors: bool,
    /// List the formats that captures are read from
    #[arg(long, group = "what")]
    pub(crate) formats: bool,
    /// List the compute devices of this machine
    #[arg(long, group = "what")]
    pub(crate) devices: bool,
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE", help_heading = "Captures")]
    pub(crate) sensor: Option<String>,
    /// Write the mean picture as PNG: response inverted, bad pixels repaired
    #[arg(long, value_name = "PNG", value_hint = ValueHint::FilePath, help_heading = "Captures")]
    pub(crate) preview: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}
