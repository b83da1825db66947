//! Weights of the networks of this project: from a file, or built in.

use crate::error::{CliError, Result};
use burn::tensor::Device;
use qudi_core::Error;
use qudi_model::ComputePrecision;
use qudi_model::checkpoint::{Description, Network, describe, describe_bytes, load, load_bytes};
use qudi_model::colour::ColourNetwork;
use qudi_model::config::NetworkKind;
use sha2::{Digest, Sha256};
use std::fmt;
use std::path::{Path, PathBuf};

/// Name of built-in weights, instead of a file.
pub(crate) const NAME: &str = "built in";

/// A network in the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BuiltIn {
    /// The regression.
    Regression,
    /// The diffusion.
    Diffusion,
    /// The correction of the diffusion's means.
    Correction,
}

/// Weights in the program (docs/model-card.md), with their SHA-256: a link to large files or a bad disk is
/// not taken for them.
struct Embedded {
    bytes: &'static [u8],
    sha256: &'static str,
}

static REGRESSION: Embedded = Embedded {
    bytes: include_bytes!("../weights/regression.safetensors"),
    sha256: include_str!("../weights/regression.sha256"),
};

static DIFFUSION: Embedded = Embedded {
    bytes: include_bytes!("../weights/diffusion.safetensors"),
    sha256: include_str!("../weights/diffusion.sha256"),
};

static CORRECTION: Embedded = Embedded {
    bytes: include_bytes!("../weights/correction.safetensors"),
    sha256: include_str!("../weights/correction.sha256"),
};

static COLOUR: Embedded = Embedded {
    bytes: include_bytes!("../weights/colour.safetensors"),
    sha256: include_str!("../weights/colour.sha256"),
};

/// Place of weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Weights {
    /// The program.
    BuiltIn(BuiltIn),
    /// A file.
    File(PathBuf),
}

impl Weights {
    /// Reads their description.
    pub(crate) fn describe(&self) -> Result<Description> {
        Ok(match self {
            Self::BuiltIn(network) => {
                describe_bytes(network.embedded().verified()?, Path::new(NAME))?
            }
            Self::File(path) => describe(path)?,
        })
    }

    /// Reads the network onto `device`.
    pub(crate) fn load<N: Network>(&self, device: &Device) -> Result<(N, Description)> {
        Ok(match self {
            Self::BuiltIn(network) => {
                load_bytes(network.embedded().verified()?, Path::new(NAME), device)?
            }
            Self::File(path) => load(path, device)?,
        })
    }

    /// Returns the SHA-256 of the whole file, in hexadecimal.
    pub(crate) fn sha256(&self) -> Result<String> {
        match self {
            Self::BuiltIn(network) => Ok(network.embedded().sha256.trim().to_owned()),
            Self::File(path) => {
                let bytes =
                    std::fs::read(path).map_err(|e| Error::io("read the weights", path, e))?;
                Ok(sha256(&bytes))
            }
        }
    }
}

impl fmt::Display for Weights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BuiltIn(_) => f.write_str(NAME),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// Returns the recipes in a file of weights; none if it has none, or cannot be read.
pub(crate) fn recipes_of(path: &Path) -> Vec<String> {
    if let Ok(description) = describe(path) {
        return description.provenance.recipes;
    }
    let contents = qudi_baselines::import::describe(path, &Device::flex()).ok().flatten();
    let description = contents.and_then(|contents| contents.description);
    description.map(|description| description.provenance.recipes).unwrap_or_default()
}

/// Reads the network that corrects colours, for the processor.
pub(crate) fn colour_network() -> Result<ColourNetwork> {
    let device = Device::flex();
    let precision = ComputePrecision::fastest(&device);
    let bytes = COLOUR.verified()?;
    Ok(ColourNetwork::of_bytes(bytes, Path::new(NAME), precision, &device)?)
}

impl BuiltIn {
    /// Returns the network of this kind that works by itself.
    pub(crate) fn of(kind: NetworkKind) -> Self {
        match kind {
            NetworkKind::Regression => Self::Regression,
            NetworkKind::Diffusion | NetworkKind::Window => Self::Diffusion,
        }
    }

    fn embedded(self) -> &'static Embedded {
        match self {
            Self::Regression => &REGRESSION,
            Self::Diffusion => &DIFFUSION,
            Self::Correction => &CORRECTION,
        }
    }
}

impl Embedded {
    /// Returns the bytes if they are whole.
    fn verified(&self) -> Result<&'static [u8]> {
        let found = sha256(self.bytes);
        if found == self.sha256.trim() {
            return Ok(self.bytes);
        }
        Err(CliError::new(
            format!("the weights in this program are damaged: their SHA-256 is {found}"),
            "crates/qudi-cli/weights",
            "clone the repository again and build, or name other --weights",
        ))
    }
}

pub(crate) fn sha256(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_model::regression::Regression;
    use qudi_model::window::Window;

    #[test]
    fn built_in_weights_are_whole_and_small() {
        let device = Device::flex();
        let [regression, correction] = [BuiltIn::Regression, BuiltIn::Correction].map(|network| {
            let loaded = Weights::BuiltIn(network).load::<Regression>(&device);
            loaded.unwrap_or_else(|e| panic!("{e:?}")).1
        });
        let diffusion = Weights::BuiltIn(BuiltIn::Diffusion).load::<Window>(&device);
        let (_, diffusion) = diffusion.unwrap_or_else(|e| panic!("{e:?}"));
        let all = [(regression, "small"), (diffusion, "window"), (correction, "correction")];
        for (description, preset) in all {
            assert!(description.network.parameters(&device) <= 3_500_000);
            // Training data was under licences that let weights be published (docs/model-card.md).
            assert_eq!(description.provenance.licence, "MIT OR Apache-2.0");
            assert_eq!(description.preset.as_deref(), Some(preset));
        }
        colour_network().unwrap_or_else(|e| panic!("{e:?}"));
        let all =
            [&REGRESSION, &DIFFUSION, &CORRECTION, &COLOUR].map(|weights| weights.bytes.len());
        assert!(all.iter().sum::<usize>() <= 10 << 20);
    }
}
