//! Options of commands that may run the network.

use super::number;
use crate::error::{Fault, Result};
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
    /// Reverse diffusion steps. With 0 the frames are a regression: fastest, and closest to the truth on average. More steps
    /// draw sharper pictures, whose details are invented; the paper takes 10 [default: what the weights say of themselves]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<usize>(0..=1000))]
    steps: Option<usize>,
    /// How the times of these steps lie [default: learnt]
    #[arg(long, value_name = "NAME")]
    spacing: Option<SpacingName>,
    /// How noise leaves [default: ddim]
    #[arg(long, value_name = "NAME")]
    sampler: Option<SamplerName>,
    /// Pictures drawn; the result is their mean, --uncertainty their spread [default: 1]
    #[arg(long, value_name = "K", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1000))]
    samples: Option<usize>,
    /// Where it runs: auto, cpu, ndarray, wgpu, vulkan, cuda, metal, or one of several, as wgpu:1 (`qudi info --devices`)
    /// [default: auto]
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Side of the tiles that the network sees at once, in pixels: memory grows with its square [default: 512]
    #[arg(long, value_name = "PIXELS", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1 << 16))]
    tile: Option<usize>,
}

/// The method that these options belong to.
const METHOD: &str = "qudi";

impl Network {
    /// The weights that were asked for.
    pub(crate) fn weights(&self) -> Weights {
        Weights::of(self.weights.as_deref())
    }

    /// Reverse steps: those asked for, or those that the weights were made for.
    pub(crate) fn steps(&self) -> Result<usize> {
        match self.steps {
            Some(steps) => Ok(steps),
            None => Ok(self.weights().describe()?.reverse_steps()),
        }
    }

    /// How the frames are made, in words.
    pub(crate) fn mode(&self) -> Result<String> {
        Ok(match self.steps()? {
            0 => "regression".to_owned(),
            1 => "diffusion in 1 step".to_owned(),
            steps => format!("diffusion in {steps} steps"),
        })
    }

    /// How the times of the steps lie.
    pub(crate) fn spacing(&self) -> SpacingName {
        self.spacing.unwrap_or(SpacingName::Learnt)
    }

    /// How noise leaves.
    pub(crate) fn sampler(&self) -> SamplerName {
        self.sampler.unwrap_or(SamplerName::Ddim)
    }

    /// Pictures drawn.
    pub(crate) fn samples(&self) -> usize {
        self.samples.unwrap_or(1)
    }

    /// The device to compute on.
    pub(crate) fn device(&self) -> &str {
        self.device.as_deref().unwrap_or("auto")
    }

    /// Side of the tiles in pixels.
    pub(crate) fn tile(&self) -> usize {
        self.tile.unwrap_or(TILE)
    }

    /// The first option given that changes what the network makes, so that it is the method that is meant.
    pub(crate) fn meant(&self) -> Option<&'static str> {
        let given = [
            (self.weights.is_some(), "--weights"),
            (self.steps.is_some(), "--steps"),
            (self.spacing.is_some(), "--spacing"),
            (self.sampler.is_some(), "--sampler"),
            (self.samples.is_some(), "--samples"),
            (self.tile.is_some(), "--tile"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, flag)| flag)
    }

    /// Refuses these options where none of the methods is the network.
    pub(crate) fn check_methods<'a>(
        &self,
        mut methods: impl Iterator<Item = &'a str>,
    ) -> Result<()> {
        let given = self.meant().or(self.device.is_some().then_some("--device"));
        match given {
            Some(flag) if !methods.any(|method| method == METHOD) => Err(Fault::new(
                format!("{flag} is for method {METHOD}"),
                flag,
                format!("leave it out, or use --method {METHOD}"),
            )),
            _ => Ok(()),
        }
    }

    /// Refuses options that are about steps where there are none.
    pub(crate) fn check_steps(&self) -> Result<()> {
        let given = [
            (self.spacing.is_some(), "--spacing"),
            (self.sampler.is_some(), "--sampler"),
            (self.samples.is_some_and(|samples| samples > 1), "--samples"),
        ];
        match given.into_iter().find(|(given, _)| *given) {
            Some((_, flag)) if self.steps()? == 0 => Err(Fault::new(
                format!("{flag} is for diffusion, and there are 0 steps"),
                flag,
                "leave it out, or ask for --steps above 0",
            )),
            _ => Ok(()),
        }
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
