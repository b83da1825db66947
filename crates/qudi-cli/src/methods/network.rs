//! The networks of this project behind `--method qudi`, `qudi-regression` and `qudi-diffusion`: weights,
//! device, options.

use super::Built;
use super::options::NetworkOptions;
use super::trained::check;
use crate::device;
use crate::error::{CliError, Result};
use crate::memory::{available_bytes, check_tiles};
use crate::weights::Weights;
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_model::ComputePrecision;
use qudi_model::checkpoint::{Description, Sampling};
use qudi_model::config::{NetworkConfig, NetworkKind};
use qudi_model::diffusion::{Diffusion, DiffusionRestorer, FlowSource, SampleOptions};
use qudi_model::regression::{Regression, RegressionRestorer};
use qudi_model::restorer::Model;
use qudi_model::window::Window;
use serde_json::{Value, json};

/// The network that a method of this project runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NetworkChoice {
    /// The network of the named weights, or the best one with built-in weights.
    Best,
    /// A network of this kind.
    Of(NetworkKind),
}

/// A network of this project with its weights.
pub(crate) struct OwnNetwork {
    weights: Weights,
    pub(crate) description: Description,
    kind: NetworkKind,
}

impl OwnNetwork {
    /// Finds the weights of a method: the named file, or the built-in ones.
    ///
    /// # Errors
    /// [`CliError`] if there are no such weights.
    pub(crate) fn new(options: &NetworkOptions, choice: NetworkChoice) -> Result<Self> {
        let weights = match (&options.own_file, choice) {
            (Some(path), _) => Weights::File(path.clone()),
            (None, NetworkChoice::Best) => Weights::BuiltIn(NetworkKind::Regression),
            (None, NetworkChoice::Of(kind)) => Weights::BuiltIn(kind),
        };
        let description = weights.describe()?;
        let kind = match choice {
            NetworkChoice::Best => description.network.kind(),
            NetworkChoice::Of(kind) => {
                let named = description.network.kind();
                // Files hold a diffusion of either order of computation.
                if kind.is_diffusion() && named.is_diffusion() { named } else { kind }
            }
        };
        Ok(Self { weights, description, kind })
    }

    /// Returns how frames are made, in words.
    pub(crate) fn mode(&self, options: &NetworkOptions) -> String {
        let passes = match options.passes {
            1 => String::new(),
            passes => format!(" and {passes} passes"),
        };
        match (self.kind, self.sampling(options).steps) {
            (NetworkKind::Regression, _) => "regression".to_owned(),
            (_, 1) => format!("diffusion in 1 step{passes}"),
            (_, steps) => format!("diffusion in {steps} steps{passes}"),
        }
    }

    /// Returns the kind of the network. The regression predicts its uncertainty; the diffusion has steps.
    pub(crate) fn kind(&self) -> NetworkKind {
        self.kind
    }

    /// Returns the sampling that is asked for; by default the one that the weights were made for.
    fn sampling(&self, options: &NetworkOptions) -> Sampling {
        let default = self.description.sampling.unwrap_or_default();
        Sampling {
            steps: options.steps.unwrap_or(default.steps),
            spacing: options.spacing.unwrap_or(default.spacing),
        }
    }

    /// Returns the settings that frames depend on.
    pub(crate) fn settings(&self, options: &NetworkOptions) -> Result<Value> {
        let mut settings = json!({
            "weights": self.weights.to_string(),
            "weights_sha256": self.weights.sha256()?,
            "tile": options.tile,
            "precision": options.precision(&device::open(&options.device)?)?,
        });
        if self.kind.is_diffusion() {
            let sampling = self.sampling(options);
            settings["steps"] = json!(sampling.steps);
            settings["spacing"] = json!(sampling.spacing);
            settings["sampler"] = json!(options.sampler_name());
            settings["samples"] = json!(options.samples);
            if self.kind == NetworkKind::Window {
                let flow = options.flow.unwrap_or(FlowSource::Matched);
                settings["flow"] = json!(flow.name());
            }
            if options.passes > 1 {
                settings["passes"] = json!(options.passes);
            }
        }
        Ok(settings)
    }
}

/// Makes the restorer of a method, and says how it makes frames and on which device.
pub(crate) fn restorer(
    choice: NetworkChoice,
    options: &NetworkOptions,
    acquisition: &Acquisition,
    size: Size,
) -> Result<Built> {
    let own = OwnNetwork::new(options, choice)?;
    let device = device::open(&options.device)?;
    check(&own.description.provenance, acquisition)?;
    if device.is_processor() {
        let Description { network, window, .. } = &own.description;
        let smallest = 4 * network.multiple();
        check_tiles([smallest, options.tile], size, available_bytes(), |size| {
            network.memory(size, *window)
        })?;
    }
    let precision = options.precision(&device)?;
    let Description { window, passes, .. } = own.description;
    let restorer: Box<dyn Restorer> = match own.kind {
        NetworkKind::Regression => {
            let (network, description) = own.weights.load::<Regression>(&device.device)?;
            let NetworkConfig::Regression(config) = description.network else { unreachable!() };
            let model = Model { network, config, window, passes };
            let tile = options.tile;
            Box::new(RegressionRestorer::new(model, tile, precision, &device.device)?)
        }
        NetworkKind::Diffusion => {
            let (network, description) = own.weights.load::<Diffusion>(&device.device)?;
            let NetworkConfig::Diffusion(config) = description.network else { unreachable!() };
            let model = Model { network, config, window, passes };
            let options = sample_options(&own, options, precision);
            Box::new(DiffusionRestorer::new(model, options, &device.device)?)
        }
        NetworkKind::Window => {
            let (network, description) = own.weights.load::<Window>(&device.device)?;
            let NetworkConfig::Window(config) = description.network else { unreachable!() };
            let model = Model { network, config, window, passes };
            let options = sample_options(&own, options, precision);
            Box::new(DiffusionRestorer::new(model, options, &device.device)?)
        }
    };
    Ok((restorer, format!(" ({}) on {}", own.mode(options), device.name)))
}

fn sample_options(
    own: &OwnNetwork,
    options: &NetworkOptions,
    precision: ComputePrecision,
) -> SampleOptions {
    let Sampling { steps, spacing } = own.sampling(options);
    let NetworkOptions { sampler, passes, flow, samples, tile, .. } = *options;
    SampleOptions { steps, spacing, sampler, passes, flow, samples, tile, precision }
}

/// Returns the error of a device that failed, with what to do; `problem` is the device's own message.
pub(crate) fn device_failed(problem: &str, options: &NetworkOptions) -> CliError {
    let half = options.tile / 2 / 32 * 32;
    let help = if half >= 64 {
        format!(
            "--tile {half} needs a quarter of the memory; `qudi selftest` checks the device; or --device cpu"
        )
    } else {
        "check the device with `qudi selftest`, or use --device cpu".to_owned()
    };
    CliError::new(format!("the device failed: {problem}"), &options.device, help)
}
