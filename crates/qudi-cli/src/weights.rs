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

/// Weights in the program (docs/model-card.md), with their SHA-256: a link to large files or a bad disk is
/// not taken for them.
struct BuiltIn {
    bytes: &'static [u8],
    sha256: &'static str,
}

static REGRESSION: BuiltIn = BuiltIn {
    bytes: include_bytes!("../weights/regression.safetensors"),
    sha256: include_str!("../weights/regression.sha256"),
};

static DIFFUSION: BuiltIn = BuiltIn {
    bytes: include_bytes!("../weights/diffusion.safetensors"),
    sha256: include_str!("../weights/diffusion.sha256"),
};

static COLOUR: BuiltIn = BuiltIn {
    bytes: include_bytes!("../weights/colour.safetensors"),
    sha256: include_str!("../weights/colour.sha256"),
};

/// Place of weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Weights {
    /// The program.
    BuiltIn(NetworkKind),
    /// A file.
    File(PathBuf),
}

impl Weights {
    /// Reads their description.
    pub(crate) fn describe(&self) -> Result<Description> {
        Ok(match self {
            Self::BuiltIn(kind) => describe_bytes(built_in(*kind).verified()?, Path::new(NAME))?,
            Self::File(path) => describe(path)?,
        })
    }

    /// Reads the network onto `device`.
    pub(crate) fn load<N: Network>(&self, device: &Device) -> Result<(N, Description)> {
        Ok(match self {
            Self::BuiltIn(kind) => {
                load_bytes(built_in(*kind).verified()?, Path::new(NAME), device)?
            }
            Self::File(path) => load(path, device)?,
        })
    }

    /// Returns the SHA-256 of the whole file, in hexadecimal.
    pub(crate) fn sha256(&self) -> Result<String> {
        match self {
            Self::BuiltIn(kind) => Ok(built_in(*kind).sha256.trim().to_owned()),
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

fn built_in(kind: NetworkKind) -> &'static BuiltIn {
    match kind {
        NetworkKind::Regression => &REGRESSION,
        NetworkKind::Diffusion | NetworkKind::Window => &DIFFUSION,
    }
}

impl BuiltIn {
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
        let [regression, diffusion] =
            [NetworkKind::Regression, NetworkKind::Window].map(Weights::BuiltIn);
        let (_, first) = regression.load::<Regression>(&device).unwrap_or_else(|e| panic!("{e:?}"));
        let (_, second) = diffusion.load::<Window>(&device).unwrap_or_else(|e| panic!("{e:?}"));
        for (description, preset) in [(first, "small"), (second, "window")] {
            assert!(description.network.parameters(&device) <= 3_500_000);
            // Training data was under licences that let weights be published (docs/model-card.md).
            assert_eq!(description.provenance.licence, "MIT OR Apache-2.0");
            assert_eq!(description.preset.as_deref(), Some(preset));
        }
        colour_network().unwrap_or_else(|e| panic!("{e:?}"));
        let all = [&REGRESSION, &DIFFUSION, &COLOUR].map(|weights| weights.bytes.len());
        assert!(all.iter().sum::<usize>() <= 10 << 20);
    }
}
