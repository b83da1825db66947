//! Options of `qudi publish`.

use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Write weights in half precision, half the size, with their SHA-256 next to them
#[derive(Debug, ClapArgs)]
pub(crate) struct Publish {
    /// Weights that `qudi train` wrote
    #[arg(value_hint = ValueHint::FilePath)]
    pub(crate) weights: PathBuf,
    /// Where they go: .safetensors
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) output: PathBuf,
    /// Reverse steps that a diffusion takes by default [default: as the weights say]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub(crate) steps: Option<u16>,
}
