//! Recipes: everything that decides the result of a training, in one TOML document.

mod base;
mod keys;
mod network;
mod rules;
mod stage;

use crate::dataset::{ClipWindow, DataConfig, PackedSource, SourceKind};
use crate::learner::diffusion::TimestepLaw;
use crate::loss::LossForm;
use crate::loss::lpips::PerceptualKind;
use crate::optimizer::OptimizerKind;
use qudi_core::limits::TEXT_BYTES;
use qudi_core::regular_file::read_text;
use qudi_core::{Error, Result};
use qudi_kernels::ComputePrecision;
use qudi_model::checkpoint::Sampling;
use qudi_model::diffusion::Ablation;
use qudi_model::diffusion::timesteps::TimestepSpacing;
use qudi_model::restorer::Model;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

use base::over_base;
use keys::{set, value};

pub use base::recipe_table;
pub use network::{NetworkRecipe, recipe_names};
pub use stage::{LearningPart, StageConfig};

/// Recipe of a training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The network, with its sizes.
    pub network: NetworkRecipe,
    /// Data to learn from.
    pub data: DataConfig,
    /// Optimization and loss.
    pub train: TrainConfig,
    /// Measurement of the progress.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation: Option<ValidationConfig>,
    /// Trainings one after the other, each from the weights of the one before; none for one training.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(skip_serializing_if = "never")]
    pub stage: Vec<StageConfig>,
}

/// Optimization and loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Seed of weights and samples.
    pub seed: u64,
    /// Optimization steps.
    pub steps: u64,
    /// Samples that pass the network at once.
    pub batch: usize,
    /// Crops of cached bursts to train on; without it, every sample is a new burst.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crops: Option<CropsConfig>,
    /// Batches whose gradients are summed for one step.
    pub accumulate: usize,
    /// Optimizer.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub optimizer: OptimizerKind,
    /// Learning rate after the warm-up; a cosine leads from it to `min_lr`.
    pub lr: f64,
    /// Learning rate that the last steps fall to.
    pub min_lr: f64,
    /// Steps of linear warm-up.
    pub warmup: u64,
    /// Largest norm of a step's gradient; longer gradients are scaled down.
    pub clip: f64,
    /// Parts of the network that learn; all if none is named. The others stay as they are, bit for bit. Of
    /// the regression `["refinement"]`, or `pre` and `uncertainty`; of the diffusions all others and `pre`,
    /// without `features` in `window`.
    #[serde(default)]
    pub learns: Vec<LearningPart>,
    /// Numbers that convolutions multiply.
    #[serde(default)]
    pub precision: ComputePrecision,
    /// True if pre-denoiser and U-Net are computed twice, image by image, to save memory; gradients are the
    /// same but for rounding.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub gradient_checkpointing: bool,
    /// Decay of the weights' exponential moving average.
    pub ema: f64,
    /// Law of the timesteps to learn at.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub timesteps: TimestepLaw,
    /// Parts that are left out, to measure their value; only of the diffusion. Weights do not keep it.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub ablate: Ablation,
    /// Fraction of the samples at the noisiest timestep, where sampling begins; the others follow
    /// `timesteps`. Only of the diffusion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise_start_fraction: Option<f64>,
    /// Passes of encoding that the network learns: batches are encoded in one to so many passes, with equal
    /// chances. Only of `window`.
    #[serde(default = "one_pass", skip_serializing_if = "is_one_pass")]
    #[schemars(skip_serializing_if = "never")]
    pub passes: usize,
    /// Share of batches that follow the motion that is matched in their counts; the others follow the learnt
    /// flow, which learns from them alone. Only of `window`.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub matched: f64,
    /// Weights of the network `window`, whose frames are corrected. Only of the regression with
    /// `network.first = "diffusion"`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first: Option<String>,
    /// Steps between checkpoints.
    pub checkpoint: u64,
    /// Loss of the diffusion; the other networks have no weights to choose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss: Option<LossConfig>,
    /// Licence of the weights, an SPDX expression.
    pub licence: String,
}

impl TrainConfig {
    /// Returns the loss; all weights are 0 for networks that have none to choose.
    pub fn loss(&self) -> LossConfig {
        self.loss.unwrap_or(LossConfig {
            form: LossForm::default(),
            prediction: 0.0,
            pre: 0.0,
            perceptual: 0.0,
            term: PerceptualKind::None,
            flow: 0.0,
        })
    }

    /// Returns true if this part of the network learns.
    pub(super) fn learns(&self, part: LearningPart) -> bool {
        self.learns.is_empty() || self.learns.contains(&part)
    }

    /// Returns the fraction of the samples at the noisiest timestep.
    pub(super) fn noise_start_fraction(&self) -> f64 {
        self.noise_start_fraction.unwrap_or(0.0)
    }

    /// Returns true if batch `number` follows the motion that is matched in its counts. These batches are
    /// spread evenly.
    pub(super) fn matches(&self, number: u64) -> bool {
        let share = |count: u64| (count as f64 * self.matched).floor();
        share(number + 1) > share(number)
    }
}

/// Crops of cached bursts: reference estimates of whole bursts take long to compute, and are worse near
/// borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CropsConfig {
    /// Bursts that are drawn in all and kept in memory.
    pub bursts: u64,
    /// Consecutive frames of each burst that are kept; the others only help to restore these.
    pub cached_frames: usize,
    /// Consecutive frames of a sample.
    pub frames: usize,
    /// Side of a sample in pixels.
    pub side: usize,
}

/// Form of the loss, and weights of its terms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Form of the errors of images.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub form: LossForm,
    /// Weight of the prediction.
    pub prediction: f32,
    /// Weight of the pre-denoised frames.
    pub pre: f32,
    /// Weight of the perceptual term.
    pub perceptual: f32,
    /// Perceptual term: `none`, `lpips-vgg` or `lpips-alex`.
    pub term: PerceptualKind,
    /// Weight of the warping error of true neighbours along the flows: the flow learns from it long before it
    /// learns from the fusion.
    #[serde(default)]
    pub flow: f32,
}

/// Measurement of the progress.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ValidationConfig {
    /// Clips that are never trained on: videos and folders of frames below the data folder, or `scene:NAME`.
    pub from: Vec<String>,
    /// Frames of every clip, around its middle.
    pub frames: usize,
    /// Side of the middle square in pixels.
    pub crop: usize,
    /// Preset's name or sensor file.
    pub sensor: String,
    /// Photons per pixel and frame.
    pub ppp: Vec<f64>,
    /// Reverse steps; only of the diffusion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Spacing of the steps' timesteps, also the default of the weights.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub spacing: TimestepSpacing,
    /// Training steps between validations.
    pub every: u64,
}

fn one_pass() -> usize {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn is_one_pass(passes: &usize) -> bool {
    *passes == one_pass()
}

pub(super) fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Schemas state all defaults, those too that are not written into files.
pub(crate) fn never<T>(_: &T) -> bool {
    false
}

/// Source of validation clips in packs.
pub(super) const VALIDATION: &str = "validation";

impl Recipe {
    /// Loads a built-in recipe or a file, with keys changed: `("train.steps", "100")`.
    ///
    /// # Errors
    /// [`Error`] if there is none, or a key is unknown or wrong.
    pub fn load(name: &str, changes: &[(String, String)]) -> Result<Self> {
        match network::preset(name) {
            Some(text) => Self::parse(text, name, changes),
            None => Self::parse_in(Path::new(name).parent(), &read(name)?, name, changes),
        }
    }

    /// Reads a recipe from its text; `place` names it in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn parse(text: &str, place: &str, changes: &[(String, String)]) -> Result<Self> {
        Self::parse_in(None, text, place, changes)
    }

    fn parse_in(
        folder: Option<&Path>,
        text: &str,
        place: &str,
        changes: &[(String, String)],
    ) -> Result<Self> {
        let help = "see `qudi config docs` for the keys and docs/training.md for examples";
        let fault = |what: String| Error::request(what, place, help);
        let document: toml::Table =
            text.parse().map_err(|e: toml::de::Error| fault(e.message().to_owned()))?;
        let mut document = over_base(document, folder)?;
        for (key, text) in changes {
            set(&mut document, key, value(text))?;
        }
        let read = serde_path_to_error::deserialize(toml::Value::Table(document));
        let mut recipe: Self = read.map_err(|e: serde_path_to_error::Error<toml::de::Error>| {
            fault(format!("{}: {}", e.path(), e.inner().message()))
        })?;
        // What is changed here is changed in every stage.
        for stage in &mut recipe.stage {
            for (key, text) in changes.iter().filter(|(key, _)| !key.starts_with("stage.")) {
                stage.changes.insert(key.clone(), value(text));
            }
        }
        recipe.checked()
    }

    /// Returns the recipe as a TOML document.
    pub fn text(&self) -> String {
        toml::to_string(self).expect("plain data")
    }

    /// Returns the frames of a sample, and its side.
    pub fn sample_size(&self) -> (usize, usize) {
        let whole = (self.data.frames, self.data.crop);
        self.train.crops.map_or(whole, |crops| (crops.frames, crops.side))
    }

    /// Returns the sampling that the weights are made for.
    pub(super) fn sampling(&self) -> Sampling {
        let validation = self.validation.as_ref();
        validation.map_or_else(Sampling::default, |validation| Sampling {
            steps: validation.steps.unwrap_or(1),
            spacing: validation.spacing,
        })
    }

    /// Returns the model of a network of this recipe.
    pub(super) fn model<N, C>(&self, network: N, config: C) -> Model<N, C> {
        Model { network, config, window: self.window(), passes: self.train.passes }
    }

    /// Returns the number of frames that validations restore at once.
    fn window(&self) -> usize {
        self.validation.as_ref().map_or(self.data.frames.max(11), |validation| validation.frames)
    }

    /// Returns true if the first pre-denoiser of the regression learns, and nothing else.
    pub(super) fn trains_refinement(&self) -> bool {
        self.train.learns == [LearningPart::Refinement]
    }

    /// Returns the sources of the recipe's pack; none if it reads no files.
    pub fn packed_sources(&self) -> Vec<PackedSource> {
        let mut sources = self.data.packed_sources();
        sources.extend(self.validation_source());
        sources
    }

    /// Returns the validation clips as a source of a pack; none if no clip has files.
    pub(super) fn validation_source(&self) -> Option<PackedSource> {
        let validation = self.validation.as_ref()?;
        let files = validation.from.iter().filter(|from| !from.starts_with("scene:"));
        let from: Vec<String> = files.cloned().collect();
        (!from.is_empty()).then(|| PackedSource {
            name: VALIDATION.to_owned(),
            kind: SourceKind::Clips,
            from,
            shrink: 1.0,
            lossless: Some(ClipWindow { frames: validation.frames, crop: validation.crop }),
        })
    }
}

fn read(name: &str) -> Result<String> {
    let path = Path::new(name);
    let failed = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::NotFound => {
            let names: Vec<_> = recipe_names().collect();
            let what = format!("`{name}` is no recipe");
            Error::request(what, name, format!("name a .toml file, or one of {}", names.join(", ")))
        }
        _ => Error::io("read the recipe", path, e),
    };
    std::fs::metadata(path).map_err(failed)?;
    read_text(path, TEXT_BYTES, "read the recipe")
}
