//! Options of `qudi bench`.

use crate::args::given::Given;
use crate::args::{Network, Steps, methods, number};
use crate::methods::{COMPARED, Method};
use clap::{Args as ClapArgs, ValueHint};
use qudi_core::Size;
use std::path::PathBuf;

/// Measure speed and memory of methods
///
/// Restores one window of a simulated burst over and over: one round to warm up, then medians. Keep the
/// results with --json, and compare with them later.
#[derive(Debug, ClapArgs)]
pub(crate) struct Bench {
    #[command(flatten)]
    pub(crate) given: Given,
    /// Methods to measure
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_values = COMPARED, value_parser = methods())]
    pub(crate) method: Vec<&'static Method>,
    /// Frame size, height first
    #[arg(long, value_name = "HxW", default_value = "256x256")]
    pub(crate) size: Size,
    /// Frames of the window
    #[arg(long, value_name = "N", default_value_t = 11, allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1000))]
    pub(crate) frames: usize,
    /// Measured rounds
    #[arg(long, value_name = "N", default_value_t = 7, allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=10_000))]
    pub(crate) rounds: usize,
    /// Results of an earlier run (--json) to compare with
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) compare: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) steps: Steps,
    #[command(flatten)]
    pub(crate) network: Network,
}
