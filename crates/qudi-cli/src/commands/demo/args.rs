//! Options of `qudi demo`.

use crate::args::given::Given;
use crate::args::{Network, Steps, number};
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// See what the camera sees, and what every method makes of it: built-in scenes in one picture and one page
#[derive(Debug, ClapArgs)]
pub(crate) struct Demo {
    #[command(flatten)]
    pub(crate) given: Given,
    /// Picture to write [default: qudi-demo.png, overwritten]
    #[arg(short, long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) output: Option<PathBuf>,
    /// Write an animated picture as well, next to the other: counts, the best classical method, QuDi, truth
    /// (GIF, at most 2 MB)
    #[arg(long)]
    pub(crate) animate: bool,
    /// Write a picture of what the diffusion draws as well, next to the other: one step, ten steps with two
    /// draws of noise, the mean and the spread of eight, errors, truth (.jpg, at most 150 kB)
    #[arg(long = "diffusion")]
    pub(crate) with_diffusion: bool,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, default_value_t = 3.25, value_parser = number::real(number::PPP))]
    pub(crate) ppp: f64,
    /// Seed of photons and noise
    #[arg(long, value_name = "N", default_value_t = 1, allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=u64::MAX))]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) steps: Steps,
    #[command(flatten)]
    pub(crate) network: Network,
}
