//! Stages of a recipe: trainings one after the other, each from the weights of the one before.

use super::keys::set;
use super::{Recipe, TrainConfig, is_default};
use crate::loss::NoiseOn;
use crate::loss::lpips::PerceptualKind;
use qudi_core::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One stage: the recipe with some of its keys changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StageConfig {
    /// The name, which its folder has, too.
    pub name: String,
    /// Keys of the recipe and their values here, such as `"train.steps" = 9000`.
    #[serde(default)]
    #[schemars(with = "serde_json::Map<String, serde_json::Value>")]
    pub changes: toml::Table,
}

/// Parts of the network that can learn without the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LearningPart {
    /// The pre-denoiser.
    Pre,
    /// The head that predicts the uncertainty of its frames.
    Uncertainty,
    /// Features of all kinds.
    Features,
    /// The optical flow.
    Flow,
    /// The temporal fusion.
    Fusion,
    /// The U-Net.
    Unet,
}

impl LearningPart {
    /// Whether the parameter of this name belongs to it.
    pub fn has(self, parameter: &str) -> bool {
        let modules: &[&str] = match self {
            Self::Pre => &["pre"],
            Self::Uncertainty => &["uncertainty"],
            Self::Features => &["low", "high"],
            Self::Flow => &["flow"],
            Self::Fusion => &["fusion"],
            Self::Unet => &["unet"],
        };
        parameter.split('.').next().is_some_and(|module| modules.contains(&module))
    }
}

impl Recipe {
    /// The recipes of all stages, in their order, with the stages' names; none for a recipe without stages.
    ///
    /// # Errors
    /// [`Error`] if a stage changes a key that is none, or makes a recipe that cannot be.
    pub fn stages(&self) -> Result<Vec<(String, Self)>> {
        let whole = Self { stage: Vec::new(), ..self.clone() };
        let document = whole.text().parse::<toml::Table>().expect("it was written as such");
        let mut stages = Vec::new();
        for (number, stage) in self.stage.iter().enumerate() {
            let place = format!("stage.{number}.changes");
            let fault = |what: String| Error::request(what, &place, "correct the recipe");
            let mut document = document.clone();
            for (key, value) in &stage.changes {
                set(&mut document, key, value.clone()).map_err(|error| fault(error.to_string()))?;
            }
            let recipe: Self = document
                .try_into()
                .map_err(|error: toml::de::Error| fault(error.message().to_owned()))?;
            stages.push((stage.name.clone(), recipe.checked()?));
        }
        Ok(stages)
    }
}

/// What a training must keep to about the noisy images, and the timesteps of them: as [`rules`].
pub(super) fn noise_rules(recipe: &Recipe) -> [(&'static str, bool, &'static str); 2] {
    let train = &recipe.train;
    let on_truth = train.noise_on == NoiseOn::Truth;
    let steps = |fits: fn(usize) -> bool| {
        recipe.validation.as_ref().is_none_or(|validation| validation.steps.is_some_and(fits))
    };
    let of_two = is_default(&train.timesteps);
    [
        (
            "train.noise_on",
            on_truth || (steps(|steps| steps >= 2) && train.loss().prediction > 0.0),
            "must be \"truth\" unless the prediction has a weight and validation.steps is 2 or more",
        ),
        (
            "train.timesteps",
            on_truth || !of_two || steps(|steps| steps == 2),
            "must be \"uniform\" where train.noise_on is \"estimate\" and validation.steps is more than 2",
        ),
    ]
}

/// What a training must keep to about the parts that learn, if the network `has_flow`: key, whether it does, and
/// what it must do.
pub(super) fn rules(
    train: &TrainConfig,
    has_flow: bool,
) -> [(&'static str, bool, &'static str); 4] {
    let learns = |part| train.learns.is_empty() || train.learns.contains(&part);
    let (loss, checkpointing) = (train.loss(), train.gradient_checkpointing);
    let alone = loss.prediction == 0.0 && loss.term == PerceptualKind::None;
    let taught = [LearningPart::Pre, LearningPart::Uncertainty, LearningPart::Flow];
    let is_taught = |part: &LearningPart| has_flow || *part != LearningPart::Flow;
    [
        (
            "train.learns",
            !alone || taught.into_iter().filter(is_taught).any(learns),
            "must name a part that the loss teaches: pre, uncertainty or flow where prediction has no weight",
        ),
        (
            "train.learns",
            learns(LearningPart::Pre) || (loss.pre == 0.0 && !checkpointing),
            "must have pre where train.loss.pre has a weight or train.gradient_checkpointing is true",
        ),
        (
            "train.learns",
            learns(LearningPart::Flow) || loss.flow == 0.0,
            "must have flow where train.loss.flow has a weight",
        ),
        (
            "train.gradient_checkpointing",
            !checkpointing || !alone,
            "must be false where pre-denoiser and flow learn alone: nothing is computed again there",
        ),
    ]
}

/// Whether all names can name folders, each its own.
pub(super) fn have_good_names(stages: &[StageConfig]) -> bool {
    let is_good = |name: &str| {
        let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        (1..=40).contains(&name.len()) && name.chars().all(allowed)
    };
    let is_first = |(number, stage): (usize, &StageConfig)| {
        is_good(&stage.name) && !stages[..number].iter().any(|other| other.name == stage.name)
    };
    stages.iter().enumerate().all(is_first)
}
