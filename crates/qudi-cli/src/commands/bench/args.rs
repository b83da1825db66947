//! Options of `qudi bench`.

use crate::args::given::Given;
use crate::args::{Network, Steps, methods, number};
use crate::methods::{COMPARED, Method};
use clap::{Args as ClapArgs, ValueHint};
use qudi_core::Size;
use std::path::PathBuf;

/// Measure speed and memory of methods, or the speed of training
///
/// Restores one window of a simulated burst over and over: one round to warm up, then medians. Keep the
/// results with --json, and compare with them later. With --train it takes training steps of a recipe, which
/// --set changes, and forgets them.
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
    /// Measure training steps of this recipe instead
    #[arg(long, value_name = "RECIPE", conflicts_with_all = ["method", "size", "frames", "rounds", "compare", "steps", "weights", "spacing", "sampler", "passes", "flow", "correct", "samples", "tile", "precision"])]
    pub(crate) train: Option<String>,
    /// --train: the recipe's decoded data, made by `qudi train --prepare`
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, requires = "train")]
    pub(crate) pack: Option<PathBuf>,
    /// --train: how long
    #[arg(long, value_name = "S", default_value = "60", requires = "train", allow_negative_numbers = true, value_parser = number::real(number::SECONDS))]
    pub(crate) seconds: f64,
    /// --train: threads that draw samples [default: as for `qudi train`]
    #[arg(long, value_name = "N", requires = "train", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=number::MAX_THREADS))]
    pub(crate) workers: Option<usize>,
    /// --train: folder with the weights of LPIPS, as for `qudi train`
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath, requires = "train")]
    pub(crate) backbones: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) steps: Steps,
    #[command(flatten)]
    pub(crate) network: Network,
}
