//! Options of networks, with defaults filled in.

use crate::args::given::Given;
use crate::device::Opened;
use crate::error::{CliError, Result};
use crate::methods::learned::LearnedWeights;
use crate::methods::network::OwnNetwork;
use crate::methods::{Method, QUDI, QUDI_DIFFUSION};
use qudi_baselines::import;
use qudi_model::ComputePrecision;
use qudi_model::diffusion::FlowSource;
use qudi_model::diffusion::sampler::Sampler;
use qudi_model::diffusion::timesteps::TimestepSpacing;
use std::path::PathBuf;

/// Options of the network.
#[derive(Clone, Debug)]
pub(crate) struct NetworkOptions {
    /// File of weights of a network of this project; none for the built-in ones.
    pub(crate) own_file: Option<PathBuf>,
    /// Number of files of weights named for this network.
    pub(crate) own_files: usize,
    /// Files of weights of the learned methods of others.
    pub(crate) learned: Vec<(import::Method, PathBuf)>,
    /// Reverse steps; none for the default of the weights.
    pub(crate) steps: Option<usize>,
    /// Spacing of the timesteps; none for the default of the weights.
    pub(crate) spacing: Option<TimestepSpacing>,
    /// The sampler.
    pub(crate) sampler: Sampler,
    /// Passes of encoding.
    pub(crate) passes: usize,
    /// True if the mean of one step is corrected.
    pub(crate) correct: bool,
    /// What finds the motion; none for the best that the weights can follow.
    pub(crate) flow: Option<FlowSource>,
    /// The number of samples.
    pub(crate) samples: usize,
    /// The device to compute on.
    pub(crate) device: String,
    /// Side of the tiles in pixels.
    pub(crate) tile: usize,
    /// Precision of convolutions; none for the fastest.
    pub(crate) precision: Option<ComputePrecision>,
    /// `--tile`, if given; any network takes it, like `--device`.
    pub(crate) tile_flag: Option<&'static str>,
    /// `--device`, if given.
    pub(crate) device_flag: Option<&'static str>,
    /// Flags on the command line that not all networks take.
    pub(crate) given: Given,
}

impl NetworkOptions {
    /// Returns the precision of convolutions on a device.
    pub(crate) fn precision(&self, device: &Opened) -> Result<ComputePrecision> {
        let precision = self.precision.unwrap_or_else(|| ComputePrecision::fastest(&device.device));
        if precision.is_supported(&device.device) {
            return Ok(precision);
        }
        let what = format!("{} cannot compute with {precision} numbers", device.name);
        Err(CliError::new(what, "--precision", "ask for another, or another --device"))
    }

    /// Returns the name of the sampler on the command line.
    pub(crate) fn sampler_name(&self) -> &'static str {
        match self.sampler {
            Sampler::Ddim => "ddim",
            Sampler::Ancestral => "ancestral",
        }
    }

    /// Refuses these options where none of the methods is the network.
    pub(crate) fn check_methods(&self, methods: &[&Method]) -> Result<()> {
        self.check_weights(methods)?;
        self.check_diffusion(methods)?;
        let is_own = methods.iter().any(|method| method.as_own().is_some());
        let is_network = methods.iter().any(|method| method.is_network());
        match (&self.given.own, self.tile_flag.or(self.device_flag)) {
            (Some(flag), _) if !is_own => Err(other_method(flag)),
            (None, Some(flag)) if !is_network => {
                let help = format!("leave it out, or use --method {}", QUDI.name);
                Err(CliError::new(format!("{flag} is for networks"), flag, help))
            }
            _ => Ok(()),
        }
    }

    /// Refuses options of the diffusion where none of the methods is one.
    pub(crate) fn check_diffusion(&self, methods: &[&Method]) -> Result<()> {
        let Some(flag) = &self.given.diffusion else { return Ok(()) };
        for choice in methods.iter().filter_map(|method| method.as_own()) {
            if OwnNetwork::new(self, choice)?.kind().is_diffusion() {
                return Ok(());
            }
        }
        let name = QUDI_DIFFUSION.name;
        Err(CliError::new(
            format!("{flag} is for method {name}"),
            flag,
            format!("leave it out, or use --method {name}"),
        ))
    }

    /// Refuses weights of learned methods that are not among `methods`, and two files for one of them.
    pub(crate) fn check_weights(&self, methods: &[&Method]) -> Result<()> {
        if self.own_files > 1 {
            let help = "name one, or METHOD=FILE for weights of other methods";
            return Err(CliError::new(
                format!("several files of weights for `{}`", QUDI.name),
                "--weights",
                help,
            ));
        }
        for (number, (method, _)) in self.learned.iter().enumerate() {
            let name = method.name();
            if self.learned[..number].iter().any(|(other, _)| other == method) {
                let what = format!("two files of weights for `{name}`");
                return Err(CliError::new(what, "--weights", "name one for each method"));
            }
            if !methods.iter().any(|asked| asked.as_learned() == Some(*method)) {
                let what = format!("weights of `{name}`, which is not asked for");
                let help = format!("leave them out, or use --method {name}");
                return Err(CliError::new(what, "--weights", help));
            }
        }
        Ok(())
    }

    /// Returns a learned method's weights: the named file, or the built-in ones.
    pub(crate) fn weights_of(&self, method: import::Method) -> Result<LearnedWeights<'_>> {
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

    /// Returns size and steps of a learned method's weights if they were trained here; none for other methods
    /// and for weights of others.
    pub(crate) fn trained_here(&self, method: &Method) -> Result<Option<String>> {
        let Some(method) = method.as_learned() else { return Ok(None) };
        let contents = self.weights_of(method)?.describe()?;
        Ok(contents.and_then(|contents| {
            let steps = contents.description?.provenance.steps;
            Some(format!("{}, {steps} steps", contents.sizes))
        }))
    }
}

/// Returns the error for a flag of the method `qudi` with another method.
fn other_method(flag: &str) -> CliError {
    CliError::new(
        format!("{flag} is for method {}", QUDI.name),
        flag,
        format!("leave it out, or use --method {}", QUDI.name),
    )
}
