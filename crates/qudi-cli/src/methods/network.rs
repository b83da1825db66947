//! The networks of this project behind `--method qudi`, `qudi-regression` and `qudi-diffusion`: weights,
//! device, options.

use super::Built;
use super::options::NetworkOptions;
use super::trained::check;
use crate::device;
use crate::error::{CliError, Result};
use crate::memory::{available_bytes, check_tiles};
use crate::weights::{BuiltIn, Weights};
use burn::tensor::Device;
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_model::ComputePrecision;
use qudi_model::checkpoint::{Description, Sampling};
use qudi_model::config::{NetworkConfig, NetworkKind};
use qudi_model::diffusion::{Diffusion, DiffusionRestorer, FlowSource, SampleOptions};
use qudi_model::regression::{FirstFrames, Regression, RegressionConfig, RegressionRestorer};
use qudi_model::restorer::Model;
use qudi_model::window::{Window, WindowConfig};
use serde_json::{Value, json};
use std::sync::Arc;

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
            (None, NetworkChoice::Best) => Weights::BuiltIn(BuiltIn::Regression),
            (None, NetworkChoice::Of(kind)) => Weights::BuiltIn(BuiltIn::of(kind)),
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
            (NetworkKind::Regression, _) if self.corrects_diffusion() => {
                "diffusion in 1 step, corrected".to_owned()
            }
            (NetworkKind::Regression, _) => "regression".to_owned(),
            (_, 1) if options.correct => format!("diffusion in 1 step{passes}, corrected"),
            (_, 1) => format!("diffusion in 1 step{passes}"),
            (_, steps) => format!("diffusion in {steps} steps{passes}"),
        }
    }

    /// Returns the kind of the network. The regression predicts its uncertainty; the diffusion has steps.
    pub(crate) fn kind(&self) -> NetworkKind {
        self.kind
    }

    /// Returns true if the network corrects the means that the built-in diffusion predicts.
    fn corrects_diffusion(&self) -> bool {
        let sizes = &self.description.network;
        matches!(sizes, NetworkConfig::Regression(config) if config.first == FirstFrames::Diffusion)
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
        if self.corrects_diffusion() {
            settings["diffusion_sha256"] = json!(Weights::BuiltIn(BuiltIn::Diffusion).sha256()?);
        }
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
            if options.correct {
                let correction = Weights::BuiltIn(BuiltIn::Correction).sha256()?;
                settings["correction_sha256"] = json!(correction);
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
        let other = match (own.corrects_diffusion(), options.correct) {
            (true, _) => Some(BuiltIn::Diffusion),
            (false, true) => Some(BuiltIn::Correction),
            (false, false) => None,
        };
        let other = other.map(|other| Weights::BuiltIn(other).describe()).transpose()?;
        check_tiles([smallest, options.tile], size, available_bytes(), |size| {
            let other = other.as_ref().map(|other| &other.network);
            let networks = [Some(network), other].into_iter().flatten();
            networks.map(|network| network.memory(size, *window)).max().unwrap_or(0)
        })?;
    }
    let precision = options.precision(&device)?;
    let corrects = own.corrects_diffusion();
    let restorer: Box<dyn Restorer> = match own.kind {
        NetworkKind::Regression => {
            let model = regression_model(&own.weights, &device.device)?;
            let first = || first_frames(options, precision, &device.device);
            let diffusion = corrects.then(first).transpose()?;
            let tile = options.tile;
            Box::new(RegressionRestorer::new(model, diffusion, tile, precision, &device.device)?)
        }
        NetworkKind::Diffusion if options.correct => {
            let what = "a correction of another network than `window`";
            return Err(CliError::new(what, "--correct", "leave it out, or name other --weights"));
        }
        NetworkKind::Diffusion => {
            let (network, description) = own.weights.load::<Diffusion>(&device.device)?;
            let NetworkConfig::Diffusion(config) = description.network else { unreachable!() };
            let Description { window, passes, .. } = own.description;
            let model = Model { network, config, window, passes };
            let options = sample_options(&own, options, precision);
            Box::new(DiffusionRestorer::new(model, options, &device.device)?)
        }
        NetworkKind::Window => {
            let sampling = sample_options(&own, options, precision);
            if options.correct {
                check_correction(sampling)?;
            }
            let model = window_model(&own.weights, &device.device)?;
            let diffusion = DiffusionRestorer::new(model, sampling, &device.device)?;
            if options.correct {
                let built_in = Weights::BuiltIn(BuiltIn::Correction);
                let model = regression_model(&built_in, &device.device)?;
                let (first, tile) = (Some(Arc::new(diffusion)), options.tile);
                Box::new(RegressionRestorer::new(model, first, tile, precision, &device.device)?)
            } else {
                Box::new(diffusion)
            }
        }
    };
    Ok((restorer, format!(" ({}) on {}", own.mode(options), device.name)))
}

/// Loads a regression.
fn regression_model(
    weights: &Weights,
    device: &Device,
) -> Result<Model<Regression, RegressionConfig>> {
    let (network, description) = weights.load::<Regression>(device)?;
    let Description { network: NetworkConfig::Regression(config), window, passes, .. } =
        description
    else {
        unreachable!("a regression has sizes of one")
    };
    Ok(Model { network, config, window, passes })
}

/// Loads a window network.
fn window_model(weights: &Weights, device: &Device) -> Result<Model<Window, WindowConfig>> {
    let (network, description) = weights.load::<Window>(device)?;
    let Description { network: NetworkConfig::Window(config), window, passes, .. } = description
    else {
        unreachable!("a window network has sizes of one")
    };
    Ok(Model { network, config, window, passes })
}

/// Refuses to correct anything but the mean, which is no sample.
fn check_correction(sampling: SampleOptions) -> Result<()> {
    if sampling.steps == 1 && sampling.samples == 1 {
        return Ok(());
    }
    let what = format!("{} steps and {} samples, corrected", sampling.steps, sampling.samples);
    let help = "correct the mean of one step: leave out --steps and --samples, or --correct";
    Err(CliError::new(what, "--correct", help))
}

/// Loads the built-in diffusion, whose frames some weights of the regression correct.
fn first_frames(
    options: &NetworkOptions,
    precision: ComputePrecision,
    device: &Device,
) -> Result<Arc<DiffusionRestorer<Window>>> {
    let model = window_model(&Weights::BuiltIn(BuiltIn::Diffusion), device)?;
    let options = SampleOptions { tile: options.tile, precision, ..SampleOptions::default() };
    Ok(Arc::new(DiffusionRestorer::new(model, options, device)?))
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
