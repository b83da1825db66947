//! The network's weights: those of a file, or those that come along.

use crate::error::{CliError, Result};
use burn::tensor::Device;
use qudi_core::Error;
use qudi_model::checkpoint::{Description, describe, describe_bytes, load, load_bytes};
use qudi_model::network::Qudi;
use sha2::{Digest, Sha256};
use std::fmt;
use std::path::{Path, PathBuf};

/// The default weights (docs/model-card.md).
const BUILT_IN: &[u8] = include_bytes!("../weights/small.safetensors");

/// Their SHA-256, so that nothing else is taken for them: not a link to large files, not a bad disk.
const SHA256: &str = include_str!("../weights/small.sha256");

/// What weights that come along are called where a file would be named.
pub(crate) const NAME: &str = "built in";

/// Where weights are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Weights {
    /// In the program.
    BuiltIn,
    /// In a file.
    File(PathBuf),
}

impl Weights {
    /// Those of `file`, or the default.
    pub(crate) fn of(file: Option<&Path>) -> Self {
        file.map_or(Self::BuiltIn, |path| Self::File(path.to_owned()))
    }

    /// What they say of themselves.
    pub(crate) fn describe(&self) -> Result<Description> {
        Ok(match self {
            Self::BuiltIn => describe_bytes(verified()?, Path::new(NAME))?,
            Self::File(path) => describe(path)?,
        })
    }

    /// The network, on `device`.
    pub(crate) fn load(&self, device: &Device) -> Result<(Qudi, Description)> {
        Ok(match self {
            Self::BuiltIn => load_bytes(verified()?, Path::new(NAME), device)?,
            Self::File(path) => load(path, device)?,
        })
    }

    /// SHA-256 of the whole file, in hexadecimal.
    pub(crate) fn sha256(&self) -> Result<String> {
        match self {
            Self::BuiltIn => Ok(SHA256.trim().to_owned()),
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
            Self::BuiltIn => f.write_str(NAME),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// The default weights, if they are what they should be.
fn verified() -> Result<&'static [u8]> {
    let found = sha256(BUILT_IN);
    if found == SHA256.trim() {
        return Ok(BUILT_IN);
    }
    Err(CliError::new(
        format!("the weights in this program are damaged: their SHA-256 is {found}"),
        "crates/qudi-cli/weights",
        "clone the repository again and build, or name other --weights",
    ))
}

pub(crate) fn sha256(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_weights_are_whole_and_small() {
        let weights = Weights::BuiltIn;
        let device = Device::flex();
        let (_, description) = weights.load(&device).unwrap_or_else(|e| panic!("{e:?}"));
        assert!(description.network.parameters(&device) <= 3_000_000);
        assert!(BUILT_IN.len() <= 8 << 20, "{} bytes", BUILT_IN.len());
        // What was learnt from is under licences that let weights be published (docs/model-card.md).
        assert_eq!(description.provenance.licence, "MIT OR Apache-2.0");
        assert_eq!(description.preset.as_deref(), Some("small"));
    }
}
