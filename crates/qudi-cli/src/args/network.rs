//! Options of commands that may run the network.

use crate::weights::Weights;
use clap::{Args as ClapArgs, ValueEnum, ValueHint};
use qudi_model::restorer::TILE;
use std::path::PathBuf;

/// The network, for the method `qudi`.
#[derive(Clone, Debug, ClapArgs)]
#[command(next_help_heading = "Network (method qudi)")]
pub(crate) struct Network {
    /// Weights that `qudi train` wrote [default: those that come along]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) weights: Option<PathBuf>,
    /// Reverse steps: 1 is fastest and truest to the photons on average; the paper takes 10, which the built-in weights do not
    /// gain from (docs/model-card.md)
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) steps: usize,
    /// How noise leaves
    #[arg(long, value_name = "NAME", default_value = "ddim")]
    pub(crate) sampler: SamplerName,
    /// Pictures drawn; the result is their mean, --deviation their spread
    #[arg(long, value_name = "K", default_value_t = 1)]
    pub(crate) samples: usize,
    /// Where it runs: auto, cpu, ndarray, wgpu, vulkan, cuda, metal, or one of several, as wgpu:1 (`qudi info --devices`)
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub(crate) device: String,
    /// Side of the tiles that the network sees at once, in pixels: memory grows with its square
    #[arg(long, value_name = "PIXELS", default_value_t = TILE)]
    pub(crate) tile: usize,
}

impl Network {
    /// The weights that were asked for.
    pub(crate) fn weights(&self) -> Weights {
        Weights::of(self.weights.as_deref())
    }
}

/// Samplers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum SamplerName {
    /// No fresh noise on the way (eta 0)
    Ddim,
    /// The noise of the posterior at every step
    Ancestral,
}
