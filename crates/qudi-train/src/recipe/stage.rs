//! Stages of a recipe: trainings one after the other, each from the weights of the one before.

use super::Recipe;
use super::keys::set;
use qudi_core::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One stage: the recipe with some of its keys changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StageConfig {
    /// Name of the stage, and of its folder.
    pub name: String,
    /// Keys of the recipe and their values here, such as `"train.steps" = 9000`.
    #[serde(default)]
    #[schemars(with = "serde_json::Map<String, serde_json::Value>")]
    pub changes: toml::Table,
}

/// Parts of a network that can learn without the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LearningPart {
    /// First pre-denoiser of the regression.
    Refinement,
    /// Pre-denoiser; the second one of the regression.
    Pre,
    /// Uncertainty head of the regression.
    Uncertainty,
    /// Features of all kinds.
    Features,
    /// Optical flow.
    Flow,
    /// Temporal fusion.
    Fusion,
    /// U-Net; of `window` also the merge of what it predicts.
    Unet,
}

impl LearningPart {
    /// Returns true if the parameter of this name belongs to it.
    pub fn has(self, parameter: &str) -> bool {
        let modules: &[&str] = match self {
            Self::Refinement => &["refinement"],
            Self::Pre => &["pre"],
            Self::Uncertainty => &["uncertainty"],
            Self::Features => &["low", "high"],
            Self::Flow => &["flow"],
            Self::Fusion => &["fusion"],
            Self::Unet => &["unet", "agreement"],
        };
        parameter.split('.').next().is_some_and(|module| modules.contains(&module))
    }
}

impl Recipe {
    /// Returns the recipes of all stages, in their order, with the stages' names; none for a recipe without
    /// stages.
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

/// Returns true if all names can name folders, each its own.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn stages_of_the_documentation_are_a_recipes() {
        let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/training.md");
        let page = std::fs::read_to_string(page).unwrap();
        let (_, block) = page.split_once("```toml\n").unwrap();
        let (block, _) = block.split_once("```").unwrap();
        let small = super::super::network::preset("small").unwrap();
        let (small, _) = small.split_once("[[stage]]").unwrap();
        let recipe = Recipe::parse(&format!("{small}{block}"), "docs/training.md", &[]).unwrap();
        let stages = recipe.stages().unwrap();
        let names: Vec<_> = stages.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["refinement", "pre-denoiser"]);
        assert_eq!(stages[1].1.train.steps, 14000);
    }
}
