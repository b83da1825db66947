//! Options of networks, defaults filled in.

use crate::device::Opened;
use crate::error::{CliError, Result};
use crate::methods::learned::LearnedWeights;
use crate::methods::network::OwnNetwork;
use crate::methods::own_kind;
use qudi_baselines::import::Method;
use qudi_model::ComputePrecision;
use qudi_model::config::NetworkKind;
use qudi_model::diffusion::sampler::Sampler;
use qudi_model::diffusion::timesteps::TimestepSpacing;
use std::path::PathBuf;

/// Options of the network.
#[derive(Clone, Debug)]
pub(crate) struct NetworkOptions {
    /// File of weights of a network of this project; none for the built-in ones.
    pub(crate) own_file: Option<PathBuf>,
    /// How many files of weights are named for this network.
    pub(crate) own_files: usize,
    /// Files of weights of the learned methods of others.
    pub(crate) learned: Vec<(Method, PathBuf)>,
    /// Reverse steps; none for those that the weights were made for.
    pub(crate) steps: Option<usize>,
    /// The spacing of their timesteps; none for that which the weights were made for.
    pub(crate) spacing: Option<TimestepSpacing>,
    /// The sampler.
    pub(crate) sampler: Sampler,
    /// The number of samples.
    pub(crate) samples: usize,
    /// The device to compute on.
    pub(crate) device: String,
    /// Side of the tiles in pixels.
    pub(crate) tile: usize,
    /// Numbers that convolutions multiply; none for the fastest.
    pub(crate) precision: Option<ComputePrecision>,
    /// The first flag given that is about the method `qudi` alone.
    pub(crate) own_flag: Option<&'static str>,
    /// `--tile`, if given: for any network, as the next one.
    pub(crate) tile_flag: Option<&'static str>,
    /// `--device`, if given.
    pub(crate) device_flag: Option<&'static str>,
    /// The first flag given that is about diffusion steps.
    pub(crate) diffusion_flag: Option<&'static str>,
}

impl NetworkOptions {
    /// Numbers that convolutions multiply on a device.
    pub(crate) fn precision(&self, device: &Opened) -> Result<ComputePrecision> {
        let precision = self.precision.unwrap_or_else(|| ComputePrecision::fastest(&device.device));
        if precision.is_supported(&device.device) {
            return Ok(precision);
        }
        let what = format!("{} cannot compute with {precision} numbers", device.name);
        Err(CliError::new(what, "--precision", "ask for another, or another --device"))
    }

    /// The name of the sampler on the command line.
    pub(crate) fn sampler_name(&self) -> &'static str {
        match self.sampler {
            Sampler::Ddim => "ddim",
            Sampler::Ancestral => "ancestral",
        }
    }

    /// Refuses these options where none of the methods is the network.
    pub(crate) fn check_methods<'a>(
        &self,
        mut methods: impl Iterator<Item = &'a str>,
    ) -> Result<()> {
        let methods: Vec<&str> = methods.by_ref().collect();
        self.check_weights(&methods)?;
        self.check_diffusion(&methods)?;
        let is_own = methods.iter().any(|method| own_kind(method).is_some());
        let is_learned = |method: &&str| Method::by_name(method).is_some();
        match (self.own_flag, self.tile_flag.or(self.device_flag)) {
            (Some(flag), _) if !is_own => Err(other_method(flag)),
            (None, Some(flag)) if !is_own && !methods.iter().any(is_learned) => {
                let help = "leave it out, or use --method qudi";
                Err(CliError::new(format!("{flag} is for networks"), flag, help))
            }
            _ => Ok(()),
        }
    }

    /// Refuses options of the diffusion where none of the methods is one.
    pub(crate) fn check_diffusion(&self, methods: &[&str]) -> Result<()> {
        let Some(flag) = self.diffusion_flag else { return Ok(()) };
        for kind in methods.iter().filter_map(|method| own_kind(method)) {
            if OwnNetwork::of(self, kind)?.kind() == NetworkKind::Diffusion {
                return Ok(());
            }
        }
        Err(CliError::new(
            format!("{flag} is for method qudi-diffusion"),
            flag,
            "leave it out, or use --method qudi-diffusion",
        ))
    }

    /// Refuses weights of learned methods that are not among `methods`, and two files for one of them.
    pub(crate) fn check_weights(&self, methods: &[&str]) -> Result<()> {
        if self.own_files > 1 {
            let help = "name one, or METHOD=FILE for those of other methods";
            return Err(CliError::new("several files of weights for `qudi`", "--weights", help));
        }
        for (number, (method, _)) in self.learned.iter().enumerate() {
            let name = method.name();
            if self.learned[..number].iter().any(|(other, _)| other == method) {
                let what = format!("two files of weights for `{name}`");
                return Err(CliError::new(what, "--weights", "name one for each method"));
            }
            if !methods.contains(&name) {
                let what = format!("weights of `{name}`, which is not asked for");
                let help = format!("leave them out, or use --method {name}");
                return Err(CliError::new(what, "--weights", help));
            }
        }
        Ok(())
    }

    /// A learned method's weights: those named, or those that come along.
    pub(crate) fn weights_of(&self, method: Method) -> Result<LearnedWeights<'_>> {
        let named = self.learned.iter().find(|(of, _)| *of == method);
        let named = named.map(|(_, file)| LearnedWeights::File(file));
        named.or_else(|| LearnedWeights::built_in(method)).ok_or_else(|| {
            let name = method.name();
            CliError::new(
                format!("method `{name}` has no weights here"),
                "--weights",
                format!(
                    "name a file of its authors, or of `qudi train {name}`, as in --weights {name}=FILE (docs/methods.md)"
                ),
            )
        })
    }

    /// What is known of the weights of a learned method that were trained here: their size, and the steps. None of
    /// other methods, and of weights of others.
    pub(crate) fn trained_here(&self, method: &str) -> Result<Option<String>> {
        let Some(method) = Method::by_name(method) else { return Ok(None) };
        let contents = self.weights_of(method)?.describe()?;
        Ok(contents.and_then(|contents| {
            let steps = contents.description?.provenance.steps;
            Some(format!("{}, {steps} steps", contents.sizes))
        }))
    }
}

/// A flag of the method `qudi` beside another method.
fn other_method(flag: &str) -> CliError {
    CliError::new(format!("{flag} is for method qudi"), flag, "leave it out, or use --method qudi")
}
