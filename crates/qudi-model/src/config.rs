//! Sizes of the networks, read from TOML; the presets.

use crate::diffusion::DiffusionConfig;
use crate::regression::RegressionConfig;
use crate::window::WindowConfig;
use burn::module::Module;
use burn::tensor::Device;
use qudi_core::{Error, Result, Size};
use qudi_layers::parameter_shapes;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Sizes of a network, with its kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[allow(clippy::large_enum_variant)] // one in a recipe
pub enum NetworkConfig {
    /// Regression.
    Regression(RegressionConfig),
    /// Diffusion.
    Diffusion(DiffusionConfig),
    /// Diffusion that encodes a window once.
    Window(WindowConfig),
}

/// Kind of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkKind {
    /// Regression.
    Regression,
    /// Diffusion.
    Diffusion,
    /// Diffusion that encodes a window once.
    Window,
}

impl NetworkKind {
    /// Returns true for networks that predict in reverse steps.
    pub fn is_diffusion(self) -> bool {
        self != Self::Regression
    }
}

impl fmt::Display for NetworkKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Regression => "regression",
            Self::Diffusion => "diffusion",
            Self::Window => "window diffusion",
        })
    }
}

/// The file of a preset.
#[derive(Deserialize)]
struct Document {
    network: NetworkConfig,
}

/// Names and texts of the presets, smallest first.
pub const PRESETS: &[(&str, &str)] = &[
    ("tiny", include_str!("../recipes/tiny.toml")),
    ("small", include_str!("../recipes/small.toml")),
    ("window", include_str!("../recipes/window.toml")),
    ("correction", include_str!("../recipes/correction.toml")),
    ("paper-mini", include_str!("../recipes/paper-mini.toml")),
    ("paper", include_str!("../recipes/paper.toml")),
];

impl NetworkConfig {
    /// Returns a preset by name.
    ///
    /// # Errors
    /// [`Error::Request`] if there is none of that name.
    pub fn preset(name: &str) -> Result<Self> {
        let Some((_, text)) = PRESETS.iter().find(|preset| preset.0 == name) else {
            let names: Vec<_> = PRESETS.iter().map(|preset| preset.0).collect();
            let help = format!("there are {}", names.join(", "));
            return Err(Error::request(format!("no preset named `{name}`"), "preset", help));
        };
        Self::parse(text, name)
    }

    /// Reads the `[network]` table of a TOML document; `place` names it in errors.
    ///
    /// # Errors
    /// [`Error::Request`] if there is none, or a key of it is wrong.
    pub fn parse(text: &str, place: &str) -> Result<Self> {
        let document: Document = toml::from_str(text)
            .map_err(|e| Error::request(e.message(), place, "correct the [network] table"))?;
        document.network.checked()
    }

    /// Returns the name of the preset with these sizes.
    pub fn preset_name(&self) -> Option<&'static str> {
        let is_same = |name: &str| Self::preset(name).is_ok_and(|preset| preset == *self);
        PRESETS.iter().map(|(name, _)| *name).find(|name| is_same(name))
    }

    /// Returns the kind of the network.
    pub fn kind(&self) -> NetworkKind {
        match self {
            Self::Regression(_) => NetworkKind::Regression,
            Self::Diffusion(_) => NetworkKind::Diffusion,
            Self::Window(_) => NetworkKind::Window,
        }
    }

    /// Returns the number that height and width of the frames are multiples of.
    pub fn multiple(&self) -> usize {
        match self {
            Self::Regression(config) => config.multiple(),
            Self::Diffusion(config) => config.multiple(),
            Self::Window(config) => config.multiple(),
        }
    }

    /// Estimates the bytes that restoring a window of `frames` frames takes on the processor at most, if the
    /// network sees tiles of `size`.
    pub fn memory(&self, size: Size, frames: usize) -> u64 {
        match self {
            Self::Regression(config) => config.memory(size, frames),
            Self::Diffusion(config) => config.memory(size, frames),
            Self::Window(config) => config.memory(size, frames),
        }
    }

    /// Counts the parameters.
    pub fn parameters(&self, device: &Device) -> usize {
        fn count<M: Module>(network: &M) -> usize {
            let list = parameter_shapes(network);
            list.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
        }
        match self {
            Self::Regression(config) => count(&config.uninitialized(device)),
            Self::Diffusion(config) => count(&config.uninitialized(device)),
            Self::Window(config) => count(&config.uninitialized(device)),
        }
    }

    /// Checks the sizes. They come from weight files, too: nothing may be allocated from them before this.
    ///
    /// # Errors
    /// [`Error::Request`] with the key that is wrong.
    pub fn checked(self) -> Result<Self> {
        Ok(match self {
            Self::Regression(config) => Self::Regression(config.checked()?),
            Self::Diffusion(config) => Self::Diffusion(config.checked()?),
            Self::Window(config) => Self::Window(config.checked()?),
        })
    }
}

/// A key below `network`, true if it is right, and what it must be.
pub(crate) type Rule<'a> = (&'a str, bool, &'a str);

/// What widths must be.
pub(crate) const SIZES: &str = "must be from 1 to 4096";

/// Returns true if all numbers can be widths.
pub(crate) fn are_widths(widths: &[usize]) -> bool {
    widths.iter().all(|width| (1..=4096).contains(width))
}

/// Refuses the first key that is wrong.
pub(crate) fn check(rules: &[Rule<'_>]) -> Result<()> {
    let Some((key, _, problem)) = rules.iter().find(|(_, good, _)| !good) else { return Ok(()) };
    let key = format!("network.{key}");
    Err(Error::request(format!("{key} {problem}"), &key, "see docs/network.md"))
}

/// Schemas state all defaults, those too that are not written into files.
pub(crate) fn never<T>(_: &T) -> bool {
    false
}

pub(crate) fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid() {
        let multiples: Vec<usize> = PRESETS
            .iter()
            .map(|(name, _)| NetworkConfig::preset(name).unwrap().multiple())
            .collect();
        assert_eq!(multiples, [8, 32, 8, 32, 16, 16]);
        assert!(NetworkConfig::preset("huge").unwrap_err().to_string().contains("huge"));
    }

    #[test]
    fn kinds_are_named_in_recipes() {
        let kinds =
            ["tiny", "small", "paper"].map(|name| NetworkConfig::preset(name).unwrap().kind());
        assert_eq!(kinds, [NetworkKind::Window, NetworkKind::Regression, NetworkKind::Diffusion]);
        let text = "[network]\nkind = \"regression\"\nfold = 2\nunet = 3\n";
        let error = NetworkConfig::parse(text, "wrong").unwrap_err().to_string();
        assert!(error.contains("unet"), "{error}");
    }
}
