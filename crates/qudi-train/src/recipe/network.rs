//! The network of a recipe: the diffusion network, or a learned method of others.

use qudi_baselines::method::{METHODS, Method, Sizes};
use qudi_core::{Error, Result};
use qudi_model::conditioning::AlignedNeighbours;
use qudi_model::config::{NetworkConfig, PRESETS, Part, ReferenceKind};
use schemars::JsonSchema;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

/// Returns the names of all built-in recipes: first those of the diffusion network, smallest first.
pub fn recipe_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name).chain(METHODS.map(Method::name))
}

/// Returns the text of a built-in recipe.
pub(super) fn preset(name: &str) -> Option<&'static str> {
    let own = PRESETS.iter().find(|preset| preset.0 == name).map(|(_, text)| *text);
    own.or_else(|| Method::by_name(name).map(Method::recipe))
}

/// The `[network]` table: sizes of the diffusion network, or, with the key `method`, of a learned baseline.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
#[allow(clippy::large_enum_variant)] // one in a recipe
pub enum NetworkRecipe {
    /// The diffusion network.
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
    /// The sizes of the diffusion network.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for a learned baseline.
    pub fn qudi(&self) -> Result<&NetworkConfig> {
        match self {
            Self::Qudi(config) => Ok(config),
            Self::Baseline(sizes) => {
                let what = format!("the recipe is for {}", sizes.method().name());
                Err(Error::request(what, "network.method", "name a recipe without this key"))
            }
        }
    }

    /// The sizes of a learned baseline.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for the diffusion network.
    pub fn baseline(&self) -> Result<Sizes> {
        match self {
            Self::Baseline(sizes) => Ok(*sizes),
            Self::Qudi(_) => {
                let what = "the recipe is for the diffusion network";
                Err(Error::request(what, "network", "name a recipe with network.method"))
            }
        }
    }

    /// What samples are given besides their counts; of baselines nothing.
    pub(crate) fn reference(&self) -> ReferenceKind {
        match self {
            Self::Qudi(config) => config.reference,
            Self::Baseline(_) => ReferenceKind::None,
        }
    }

    /// The neighbours that are aligned with each frame of samples.
    pub(crate) fn aligned_neighbours(&self) -> AlignedNeighbours {
        match self {
            Self::Qudi(config) => config.pre.aligned_neighbours(),
            Self::Baseline(_) => AlignedNeighbours::NONE,
        }
    }

    /// Whether samples come with the mean level of their scene. Restored images of baselines need it.
    pub(crate) fn sees_mean_level(&self) -> bool {
        match self {
            Self::Qudi(config) => !config.ablates(Part::MeanLevel),
            Self::Baseline(_) => true,
        }
    }
}
