//! The learned methods of others: their weights, and the memory that they take.

use crate::device;
use crate::error::{CliError, Result};
use crate::memory::{available_bytes, shortage};
use crate::methods::options::NetworkOptions;
use crate::weights::{NAME, Weights, sha256};
use burn::tensor::Device;
use qudi_baselines::import::{
    Contents, Loaded, Method, describe, describe_bytes, load, load_bytes,
};
use qudi_baselines::restorer::LearnedRestorer;
use qudi_core::Size;
use qudi_core::restorer::Restorer;
use std::fmt;
use std::path::Path;

/// EMVD as trained here (docs/notes/engineering/learned-methods.md).
const EMVD: &[u8] = include_bytes!("../../weights/emvd.safetensors");

/// Where the weights of a learned method are.
#[derive(Clone, Copy, Debug)]
pub(crate) enum LearnedWeights<'a> {
    /// In the program.
    BuiltIn(&'static [u8]),
    /// In a file.
    File(&'a Path),
}

impl LearnedWeights<'_> {
    /// The weights of a method that come along, if there are any.
    pub(crate) fn built_in(method: Method) -> Option<Self> {
        (method == Method::Emvd).then_some(Self::BuiltIn(EMVD))
    }

    /// What they are of, and what they say of themselves.
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

    /// SHA-256 of the whole file, in hexadecimal.
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

/// The restorer of a method, for frames of `size`, and the device that it is on.
pub(crate) fn restorer(
    method: Method,
    options: &NetworkOptions,
    size: Size,
) -> Result<(Box<dyn Restorer>, String)> {
    let weights = options.weights_of(method)?;
    let device = device::open(&options.device)?;
    let restorer = LearnedRestorer::of(weights.load(method, &device.device)?, &device.device);
    if device.is_processor() {
        check_memory(method.name(), restorer.memory(size), size, available_bytes())?;
    }
    Ok((Box::new(restorer), format!(" on {}", device.name)))
}

/// Refuses frames that memory cannot hold, before the system ends the program for it.
fn check_memory(method: &str, needed: u64, size: Size, available: Option<u64>) -> Result<()> {
    let Some(available) = available.filter(|&available| needed > available) else {
        return Ok(());
    };
    let what = shortage(&format!("for frames of {size} {method} takes"), needed, available);
    let part = (available as f64 / needed as f64).sqrt();
    let side = |length: usize| (length as f64 * part) as usize / 32 * 32;
    let (height, width) = (side(size.height), side(size.width));
    let help = if height.min(width) < 64 {
        "free some memory, or use another method".to_owned()
    } else {
        format!("--crop 0:{height},0:{width} fits: restore the frames part by part")
    };
    Err(CliError::new(what, "memory", help))
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
            assert_eq!(description.licence, "MIT OR Apache-2.0");
            assert!(weights.load(method, &Device::flex()).is_ok());
        }
    }

    #[test]
    fn frames_that_do_not_fit_name_a_part_that_does() {
        let size = Size { height: 2000, width: 3000 };
        let check = |available| check_memory("rvrt", 16 << 30, size, available);
        assert!(check(None).is_ok() && check(Some(17 << 30)).is_ok());
        let Err(CliError::Error { what, help: Some(help), .. }) = check(Some(4 << 30)) else {
            panic!("16 GiB in 4");
        };
        assert!(what.contains("16.0 GiB") && what.contains("4.0 GiB are free"), "{what}");
        assert!(help.starts_with("--crop 0:992,0:1472 "), "{help}");
    }
}
