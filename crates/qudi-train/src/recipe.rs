//! Recipes: everything that decides what a training gives, in one TOML document.

mod stage;

use crate::dataset::{DataConfig, LightRange, SensorMix, SourceConfig, SourceKind};
use crate::loss::lpips::PerceptualKind;
use crate::loss::{LossForm, NoiseOn, TimestepLaw};
use qudi_core::limits::TEXT_BYTES;
use qudi_core::regular_file::read_text;
use qudi_core::{Error, Result};
use qudi_kernels::ComputePrecision;
use qudi_model::config::{NetworkConfig, PRESETS, Part};
use qudi_model::diffusion::timesteps::TimestepSpacing;
use serde::{Deserialize, Serialize};
use std::path::Path;

pub use stage::{LearningPart, StageConfig};

/// A recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Sizes of the network.
    pub network: NetworkConfig,
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
    /// What the noise of the noisy images is added to.
    #[serde(default, skip_serializing_if = "is_default")]
    pub noise_on: NoiseOn,
    /// Fraction of the samples at the noisiest timestep, where sampling begins.
    #[serde(alias = "start")]
    pub noise_start_fraction: f64,
    /// Steps between checkpoints.
    pub checkpoint: u64,
    /// The loss.
    pub loss: LossConfig,
    /// Licence of the weights, an SPDX expression.
    pub licence: String,
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
    /// Reverse steps; 0 judges the pre-denoiser.
    pub steps: usize,
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
        let preset = PRESETS.iter().find(|preset| preset.0 == name);
        let text = match preset {
            Some((_, text)) => (*text).to_owned(),
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

    /// Reverse diffusion steps that the weights are made for: none where nothing but regression learns.
    pub(super) fn default_steps(&self) -> usize {
        if self.train.loss.prediction == 0.0 {
            return 0;
        }
        self.validation.as_ref().map_or(1, |validation| validation.steps)
    }

    /// Spacing of the timesteps that the weights are made for.
    pub(super) fn default_spacing(&self) -> TimestepSpacing {
        self.validation.as_ref().map_or_else(TimestepSpacing::default, |v| v.spacing)
    }

    /// Whether only the pre-denoiser learns: frame by frame.
    pub(super) fn learns_frames(&self) -> bool {
        let loss = &self.train.loss;
        loss.prediction == 0.0 && loss.flow == 0.0 && loss.term == PerceptualKind::None
    }

    fn checked(self) -> Result<Self> {
        let network = self.network.clone().checked()?;
        let data = self.data.clone().checked()?;
        let multiple = network.multiple();
        let train = &self.train;
        let share = |v: f64| (0.0..1.0).contains(&v);
        let weight = |v: f32| v.is_finite() && v >= 0.0;
        let (frames, side) = self.sample_size();
        let fewest = if self.learns_frames() { 1 } else { 3 };
        let rules = [
            (
                if train.crops.is_some() { "train.crops.side" } else { "data.crop" },
                side.is_multiple_of(multiple) && side > 0,
                "must be a multiple of the network's coarsest cell",
            ),
            (
                "train.crops",
                (fewest..=data.frames).contains(&frames)
                    && train
                        .crops
                        .is_none_or(|crops| (frames..=data.frames).contains(&crops.cached_frames))
                    && side <= data.crop
                    && train.crops.is_none_or(|crops| (1..=1 << 20).contains(&crops.bursts)),
                "must be of at least one burst, fit into it, and have 3 frames where more than the pre-denoiser learns",
            ),
            ("train.steps", (1..=1 << 40).contains(&train.steps), "must be at least 1"),
            ("train.batch", (1..=4096).contains(&train.batch), "must be from 1 to 4096"),
            ("train.accumulate", (1..=4096).contains(&train.accumulate), "must be from 1 to 4096"),
            ("train.lr", train.lr > 0.0 && train.lr <= 1.0, "must be above 0, at most 1"),
            (
                "train.min_lr",
                train.min_lr >= 0.0 && train.min_lr <= train.lr,
                "must be from 0 to train.lr",
            ),
            ("train.clip", train.clip > 0.0, "must be above 0"),
            ("train.ema", share(train.ema), "must be from 0 to below 1"),
            (
                "train.noise_start_fraction",
                (0.0..=1.0).contains(&train.noise_start_fraction),
                "must be from 0 to 1",
            ),
            ("train.checkpoint", train.checkpoint > 0, "must be at least 1"),
            (
                "train.loss",
                weight(train.loss.prediction)
                    && weight(train.loss.flow)
                    && weight(train.loss.pre)
                    && weight(train.loss.perceptual),
                "must have weights of 0 or more",
            ),
            (
                "train.loss.term",
                (train.loss.term == PerceptualKind::None) == (train.loss.perceptual == 0.0),
                "and train.loss.perceptual belong together: a term and its weight, or \"none\" and 0",
            ),
        ];
        let has_flow = !network.ablates(Part::Flow);
        let noise_rules = stage::noise_rules(&self);
        let named = stage::have_good_names(&self.stage);
        let stages = ("stage", named, "must have names of a-z, 0-9 and -, each its own");
        for (key, good, problem) in rules
            .into_iter()
            .chain(stage::rules(train, has_flow))
            .chain(noise_rules)
            .chain([stages])
        {
            if !good {
                let what = format!("{key} {problem}");
                return Err(Error::request(what, key, "correct the recipe"));
            }
        }
        if let Some(validation) = &self.validation {
            let good = (3..=1000).contains(&validation.frames)
                && (16..=4096).contains(&validation.crop)
                && !validation.ppp.is_empty()
                && validation.ppp.iter().all(|&ppp| ppp > 0.0 && ppp < 1e6)
                && validation.every > 0
                && !validation.from.is_empty();
            if !good {
                return Err(Error::request(
                    "the validation cannot be done: it wants clips, 3 frames, 16 pixels, light",
                    "validation",
                    "correct the recipe",
                ));
            }
        }
        self.stages()?;
        Ok(Self { network, data, ..self })
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
            let names: Vec<_> = PRESETS.iter().map(|preset| preset.0).collect();
            let what = format!("`{name}` is no recipe");
            Error::request(what, name, format!("name a .toml file, or one of {}", names.join(", ")))
        }
        _ => Error::io("read the recipe", path, e),
    };
    std::fs::metadata(path).map_err(failed)?;
    read_text(path, TEXT_BYTES, "read the recipe")
}

/// Former names of keys and their names now; both are read (`#[serde(alias)]` on the fields).
const RENAMED: &[(&str, &str)] = &[
    ("network.without", "network.ablate"),
    ("network.pre.motions", "network.pre.alignments"),
    ("network.pre.trust", "network.pre.weight_channels"),
    ("network.pre.rounds", "network.pre.stages"),
    ("network.pre.error", "network.pre.uncertainty"),
    ("data.source.rest", "data.source.static_fraction"),
    ("data.source.shrink", "data.source.max_downscale"),
    ("train.rate", "train.lr"),
    ("train.floor", "train.min_lr"),
    ("train.start", "train.noise_start_fraction"),
    ("train.parts", "train.crops"),
    ("train.crops.kept", "train.crops.cached_frames"),
];

/// Gives the keys of a table, and of the tables in it, their names of now. `path` is the table's place in the
/// recipe, without the numbers of list elements.
fn modernize(table: &mut toml::Table, path: &str) {
    for (old, new) in RENAMED {
        let names = old.rsplit_once('.').zip(new.rsplit_once('.'));
        if let Some(((place, old), (_, new))) = names
            && place == path
            && !table.contains_key(new)
            && let Some(value) = table.remove(old)
        {
            table.insert(new.to_owned(), value);
        }
    }
    for (key, value) in table.iter_mut() {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let tables = match value {
            toml::Value::Array(list) => list.as_mut_slice(),
            value => std::slice::from_mut(value),
        };
        tables.iter_mut().filter_map(toml::Value::as_table_mut).for_each(|t| modernize(t, &path));
    }
}

/// A dotted key by its name of now: `train.rate` is `train.lr`.
fn modern_key(key: &str) -> String {
    let mut modern: Vec<&str> = key.split('.').collect();
    for end in 1..=modern.len() {
        let is_name = |part: &&str| part.parse::<usize>().is_err();
        let path: Vec<_> = modern[..end].iter().copied().filter(is_name).collect();
        let path = path.join(".");
        let renamed = RENAMED.iter().find(|(old, _)| *old == path);
        if let Some((_, name)) = renamed.and_then(|(_, new)| new.rsplit_once('.')) {
            modern[end - 1] = name;
        }
    }
    modern.join(".")
}

/// A value of TOML, or a word as text.
fn value(text: &str) -> toml::Value {
    let value = format!("v = {text}").parse::<toml::Table>().ok();
    let value = value.and_then(|mut table| table.remove("v"));
    value.unwrap_or_else(|| toml::Value::String(text.to_owned()))
}

/// Sets a key below tables; numbers name the elements of a list, as in `data.source.0.weight`.
fn set(document: &mut toml::Table, key: &str, value: toml::Value) -> Result<()> {
    let unknown = || {
        let help = "name keys of the recipe, as in train.steps or data.source.0.weight";
        Error::request(format!("`{key}` is no key of the recipe"), key, help)
    };
    let (path, last) = key.rsplit_once('.').ok_or_else(unknown)?;
    let mut parts = path.split('.');
    let first = parts.next().ok_or_else(unknown)?;
    let mut at = document.get_mut(first).ok_or_else(unknown)?;
    for part in parts {
        at = match at {
            toml::Value::Table(table) => table.get_mut(part),
            toml::Value::Array(list) => part.parse().ok().and_then(|i: usize| list.get_mut(i)),
            _ => None,
        }
        .ok_or_else(unknown)?;
    }
    // Unknown names are found when the recipe is read.
    at.as_table_mut().ok_or_else(unknown)?.insert(last.to_owned(), value);
    Ok(())
}
