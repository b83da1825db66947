//! Learned methods of others: weights and memory.

use crate::device;
use crate::error::Result;
use crate::memory::{available_bytes, check_tiles};
use crate::methods::options::NetworkOptions;
use crate::methods::trained::check;
use crate::methods::{Built, Kind};
use crate::weights::{NAME, Weights, sha256};
use burn::tensor::Device;
use qudi_baselines::import::{
    Contents, Loaded, Method, describe, describe_bytes, load, load_bytes,
};
use qudi_baselines::restorer::{LearnedRestorer, SMALLEST_TILE};
use qudi_core::Size;
use qudi_core::restorer::Acquisition;
use std::fmt;
use std::path::Path;

/// Weights of EMVD as trained here (docs/notes/engineering/learned-methods.md).
pub(super) const EMVD: &[u8] = include_bytes!("../../weights/emvd.safetensors");

/// Place of the weights of a learned method.
#[derive(Clone, Copy, Debug)]
pub(crate) enum LearnedWeights<'a> {
    /// In the program.
    BuiltIn(&'static [u8]),
    /// In a file.
    File(&'a Path),
}

impl LearnedWeights<'_> {
    /// Returns the weights of a method that are in the program, if there are any.
    pub(crate) fn built_in(method: Method) -> Option<Self> {
        match super::Method::of_learned(method)?.kind {
            Kind::Learned { built_in, .. } => built_in.map(Self::BuiltIn),
            Kind::Classical(_) | Kind::Network(_) => None,
        }
    }

    /// Reads the network's name, sizes and description; none if this is no file of a learned method.
    pub(crate) fn describe(self) -> Result<Option<Contents>> {
        let device = Device::flex();
        Ok(match self {
            Self::BuiltIn(bytes) => describe_bytes(bytes, Path::new(NAME), &device)?,
            Self::File(path) => describe(path, &device)?,
        })
    }

    fn load(self, method: Method, device: &Device) -> Result<Loaded> {
        Ok(match self {
            Self::BuiltIn(bytes) => load_bytes(bytes, Path::new(NAME), method, device)?,
            Self::File(path) => load(path, method, device)?,
        })
    }

    /// Returns the SHA-256 of the whole file, in hexadecimal.
    pub(crate) fn sha256(self) -> Result<String> {
        match self {
            Self::BuiltIn(bytes) => Ok(sha256(bytes)),
            Self::File(path) => Weights::File(path.to_owned()).sha256(),
        }
    }
}

impl fmt::Display for LearnedWeights<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BuiltIn(_) => f.write_str(NAME),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// Makes the restorer of a method for frames of `size`.
pub(crate) fn restorer(
    method: Method,
    options: &NetworkOptions,
    acquisition: &Acquisition,
    size: Size,
) -> Result<Built> {
    let weights = options.weights_of(method)?;
    let device = device::open(&options.device)?;
    let loaded = weights.load(method, &device.device)?;
    if let Some(description) = &loaded.description {
        check(&description.provenance, acquisition)?;
    }
    let restorer = LearnedRestorer::of(loaded, &device.device);
    let restorer = restorer.with_tile(options.tile)?;
    if device.is_processor() {
        let sides = [SMALLEST_TILE, options.tile];
        check_tiles(sides, size, available_bytes(), |size| restorer.memory(size))?;
    }
    Ok((Box::new(restorer), format!(" on {}", device.name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_weights_are_whole_and_say_how_they_were_trained() {
        for method in qudi_baselines::import::METHODS {
            let Some(weights) = LearnedWeights::built_in(method) else { continue };
            let contents = weights.describe().unwrap_or_else(|e| panic!("{e:?}"));
            let contents = contents.unwrap_or_else(|| panic!("{method:?}: no learned method"));
            assert_eq!(contents.method, method);
            let description = contents.description.unwrap_or_else(|| panic!("{method:?}"));
            assert_eq!(description.provenance.licence, "MIT OR Apache-2.0");
            assert!(weights.load(method, &Device::flex()).is_ok());
        }
    }
}
