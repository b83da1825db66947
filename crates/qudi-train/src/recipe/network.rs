//! The network of a recipe: regression, diffusion, or a learned method of others.

use qudi_baselines::method::{METHODS, Method, Sizes};
use qudi_core::{Error, Result};
use qudi_model::config::{NetworkConfig, PRESETS};
use qudi_model::diffusion::DiffusionConfig;
use qudi_model::regression::RegressionConfig;
use qudi_model::window::WindowConfig;
use schemars::JsonSchema;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

/// Returns the names of all built-in recipes: first our own, smallest first.
pub fn recipe_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name).chain(METHODS.map(Method::name))
}

/// Returns the text of a built-in recipe.
pub(super) fn preset(name: &str) -> Option<&'static str> {
    let own = PRESETS.iter().find(|preset| preset.0 == name).map(|(_, text)| *text);
    own.or_else(|| Method::by_name(name).map(Method::recipe))
}

/// The `[network]` table: the sizes of a network of ours of this `kind`, or, with the key `method`, of a
/// learned baseline.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
#[allow(clippy::large_enum_variant)] // one in a recipe
pub enum NetworkRecipe {
    /// A network of ours.
    Qudi(NetworkConfig),
    /// A learned method of others.
    Baseline(Sizes),
}

impl<'de> Deserialize<'de> for NetworkRecipe {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let table = toml::Table::deserialize(deserializer)?;
        let fault = |e: toml::de::Error| D::Error::custom(e.message());
        if table.contains_key("method") {
            table.try_into().map(Self::Baseline).map_err(fault)
        } else {
            table.try_into().map(Self::Qudi).map_err(fault)
        }
    }
}

impl NetworkRecipe {
    /// Returns the sizes of a regression.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for another network.
    pub fn regression(&self) -> Result<&RegressionConfig> {
        match self {
            Self::Qudi(NetworkConfig::Regression(config)) => Ok(config),
            _ => Err(self.other("the regression")),
        }
    }

    /// Returns the sizes of a diffusion.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for another network.
    pub fn diffusion(&self) -> Result<&DiffusionConfig> {
        match self {
            Self::Qudi(NetworkConfig::Diffusion(config)) => Ok(config),
            _ => Err(self.other("the diffusion")),
        }
    }

    /// Returns the sizes of a diffusion that encodes a window once.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for another network.
    pub fn window(&self) -> Result<&WindowConfig> {
        match self {
            Self::Qudi(NetworkConfig::Window(config)) => Ok(config),
            _ => Err(self.other("the diffusion that encodes a window once")),
        }
    }

    /// Returns the sizes of a learned baseline.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for another network.
    pub fn baseline(&self) -> Result<Sizes> {
        match self {
            Self::Baseline(sizes) => Ok(*sizes),
            Self::Qudi(_) => Err(self.other("a learned baseline")),
        }
    }

    /// Returns the name of the network.
    pub(super) fn name(&self) -> String {
        match self {
            Self::Qudi(config) => format!("the {}", config.kind()),
            Self::Baseline(sizes) => sizes.method().name().to_owned(),
        }
    }

    fn other(&self, expected: &str) -> Error {
        let what = format!("the recipe is for {}, not for {expected}", self.name());
        Error::request(what, "network", "name another recipe")
    }
}
