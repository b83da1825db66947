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
    /// Reverse steps: 0 diffuses nothing (fastest, and truest to the photons on average), more make sharper pictures; the
    /// paper takes 10 [default: 0 with the weights that come along, else 1]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// How the times of these steps lie
    #[arg(long, value_name = "NAME", default_value = "learnt")]
    pub(crate) spacing: SpacingName,
    /// How noise leaves
    #[arg(long, value_name = "NAME", default_value = "ddim")]
    pub(crate) sampler: SamplerName,
    /// Pictures drawn; the result is their mean, --deviation their spread [with --steps above 0]
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

    /// Reverse steps. The pre-denoiser of the weights that come along has learnt longer than their U-Net.
    pub(crate) fn steps(&self) -> usize {
        self.steps.unwrap_or(usize::from(self.weights.is_some()))
    }
}

/// Spacings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum SpacingName {
    /// Evenly, as in the paper
    Linear,
    /// As densely as training drew them, by how much noise there is: sharper pictures in as many steps
    Learnt,
}

/// Samplers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum SamplerName {
    /// No fresh noise on the way (eta 0)
    Ddim,
    /// The noise of the posterior at every step
    Ancestral,
}
