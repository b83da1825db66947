//! Recipes: everything that decides what a training gives, in one TOML document.

mod keys;
mod network;
mod rules;
mod stage;

use crate::dataset::{DataConfig, LightRange, SensorMix, SourceConfig, SourceKind};
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
use serde::{Deserialize, Serialize};
use std::path::Path;

use keys::{modern_key, modernize, set, value};

pub use network::{NetworkRecipe, recipe_names};
pub use stage::{LearningPart, StageConfig};

/// A recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The network, with its sizes.
    pub network: NetworkRecipe,
    /// What it learns from.
    pub data: DataConfig,
    /// How it learns.
    pub train: TrainConfig,
    /// How its progress is measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation: Option<ValidationConfig>,
    /// Trainings one after the other, each from the weights of the one before; without any, one training.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stage: Vec<StageConfig>,
}

/// How the network learns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Seed of weights and samples.
    pub seed: u64,
    /// Optimisation steps.
    pub steps: u64,
    /// Samples that go through the network at once.
    pub batch: usize,
    /// The crops of cached bursts that are the samples; without it, every sample is a new burst.
    #[serde(default, alias = "parts", skip_serializing_if = "Option::is_none")]
    pub crops: Option<CropsConfig>,
    /// Batches whose gradients make one step.
    pub accumulate: usize,
    /// How weights move along gradients.
    #[serde(default, skip_serializing_if = "is_default")]
    pub optimizer: OptimizerKind,
    /// The learning rate after the warm-up.
    #[serde(alias = "rate")]
    pub lr: f64,
    /// The learning rate of the last step.
    #[serde(alias = "floor")]
    pub min_lr: f64,
    /// Number of steps of linear warm-up.
    pub warmup: u64,
    /// Largest norm of a step's gradient; longer ones are shortened.
    pub clip: f64,
    /// Parts of the network that learn; all if none is named. Others stay as they are, bit for bit.
    #[serde(default)]
    pub learns: Vec<LearningPart>,
    /// Numbers that convolutions multiply.
    #[serde(default)]
    pub precision: ComputePrecision,
    /// Whether the pre-denoiser is computed twice, image by image, to save its memory (gradient
    /// checkpointing); gradients are the same but for rounding.
    #[serde(default, skip_serializing_if = "is_default")]
    pub gradient_checkpointing: bool,
    /// Share of the average of weights that a step keeps.
    pub ema: f64,
    /// Law of the timesteps that the network learns at.
    #[serde(default, skip_serializing_if = "is_default")]
    pub timesteps: TimestepLaw,
    /// Parts that are left out, to measure what they are worth; only of the diffusion. Weights do not keep it.
    #[serde(default, skip_serializing_if = "is_default")]
    pub ablate: Ablation,
    /// Fraction of the samples at the noisiest timestep, where sampling begins; only of the diffusion.
    #[serde(default, alias = "start", skip_serializing_if = "Option::is_none")]
    pub noise_start_fraction: Option<f64>,
    /// Steps between checkpoints.
    pub checkpoint: u64,
    /// The loss of the diffusion; the other networks have no weights to choose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss: Option<LossConfig>,
    /// Licence of the weights, an SPDX expression.
    pub licence: String,
}

impl TrainConfig {
    /// Returns the loss; all weights are 0 of networks that have none to choose.
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

    /// Returns the fraction of the samples at the noisiest timestep.
    pub(super) fn noise_start_fraction(&self) -> f64 {
        self.noise_start_fraction.unwrap_or(0.0)
    }
}

/// What samples are cut from: reference estimates of whole bursts, which take long to compute and see no
/// borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CropsConfig {
    /// Bursts that are drawn in all and kept in memory; samples come back to them.
    pub bursts: u64,
    /// Consecutive frames of each burst that are kept; the others only help to restore these.
    #[serde(alias = "kept")]
    pub cached_frames: usize,
    /// Consecutive frames of a sample.
    pub frames: usize,
    /// Side of a sample in pixels.
    pub side: usize,
}

/// Form of the loss, and weights of its terms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// How the errors of images count.
    #[serde(default, skip_serializing_if = "is_default")]
    pub form: LossForm,
    /// The weight of the prediction.
    pub prediction: f32,
    /// The weight of the pre-denoised frames.
    pub pre: f32,
    /// The weight of the perceptual term.
    pub perceptual: f32,
    /// The kind of the perceptual term.
    pub term: PerceptualKind,
    /// The weight of the warping error of true neighbours along the flows: flow learns from it long before fusion can
    /// teach it.
    #[serde(default)]
    pub flow: f32,
}

/// How progress is measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidationConfig {
    /// Videos and folders of frames below the data folder, or procedural scenes as `scene:NAME`.
    pub from: Vec<String>,
    /// Frames of every clip, around its middle.
    pub frames: usize,
    /// Side of the middle square.
    pub crop: usize,
    /// Sensor.
    pub sensor: String,
    /// Photons per pixel and frame.
    pub ppp: Vec<f64>,
    /// Reverse steps; only of the diffusion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Spacing of their timesteps, which the weights keep for restoring.
    #[serde(default, skip_serializing_if = "is_default")]
    pub spacing: TimestepSpacing,
    /// Training steps between validations.
    pub every: u64,
}

pub(super) fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Source of validation clips in packs.
pub(super) const VALIDATION: &str = "validation";

impl Recipe {
    /// A preset's recipe, or that of a file, with keys changed: `("train.steps", "100")`.
    ///
    /// # Errors
    /// [`Error`] if there is none, or a key is unknown or wrong.
    pub fn load(name: &str, changes: &[(String, String)]) -> Result<Self> {
        let text = match network::preset(name) {
            Some(text) => text.to_owned(),
            None => read(name)?,
        };
        Self::parse(&text, name, changes)
    }

    /// A recipe from its text; `place` names it in errors.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn parse(text: &str, place: &str, changes: &[(String, String)]) -> Result<Self> {
        let help = "compare with configs/small.toml and docs/training.md";
        let fault = |what: String| Error::request(what, place, help);
        let mut document: toml::Table =
            text.parse().map_err(|e: toml::de::Error| fault(e.message().to_owned()))?;
        modernize(&mut document, "");
        for (key, text) in changes {
            set(&mut document, &modern_key(key), value(text))?;
        }
        let mut recipe: Self =
            document.try_into().map_err(|e: toml::de::Error| fault(e.message().to_owned()))?;
        // What is changed here is changed in every stage.
        for stage in &mut recipe.stage {
            for (key, text) in changes.iter().filter(|(key, _)| !key.starts_with("stage.")) {
                stage.changes.insert(modern_key(key), value(text));
            }
        }
        recipe.checked()
    }

    /// The recipe as a TOML document.
    pub fn text(&self) -> String {
        toml::to_string(self).expect("plain data")
    }

    /// Frames of a sample, and the side of one.
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

    /// Returns the number of frames that validations restore at once.
    pub(super) fn window(&self) -> usize {
        self.validation.as_ref().map_or(self.data.frames.max(11), |validation| validation.frames)
    }

    /// Returns true if the first pre-denoiser of the regression learns, and nothing else.
    pub(super) fn trains_refinement(&self) -> bool {
        self.train.learns == [LearningPart::Refinement]
    }

    /// The validation clips as a source of a pack; none if there are none with files.
    pub fn validation_data(&self) -> Option<DataConfig> {
        let validation = self.validation.as_ref()?;
        let files = validation.from.iter().filter(|from| !from.starts_with("scene:"));
        let from: Vec<String> = files.cloned().collect();
        (!from.is_empty()).then(|| DataConfig {
            frames: validation.frames,
            crop: validation.crop,
            instants: 1,
            sensor: vec![SensorMix {
                name: validation.sensor.clone(),
                ppp: LightRange::Of(validation.ppp.clone()),
                frames_summed: None,
                weight: 1.0,
            }],
            source: vec![SourceConfig {
                name: VALIDATION.to_owned(),
                kind: SourceKind::Clips,
                from,
                weight: 1.0,
                stride: 1,
                max_downscale: 1.0,
                speed: 0.0,
                static_fraction: 0.0,
            }],
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
