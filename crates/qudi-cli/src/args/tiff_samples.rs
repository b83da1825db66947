//! Samples of a `.tif` of images, as `--float` asks for.

use crate::error::{CliError, Result};
use qudi_io::writer::TiffSamples;
use std::path::Path;

/// Returns the type of samples for the output `path`.
pub(crate) fn tiff_samples(float: bool, path: &Path) -> Result<TiffSamples> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match (float, extension.as_str()) {
        (false, _) => Ok(TiffSamples::U16),
        (true, "tif" | "tiff") => Ok(TiffSamples::F32),
        (true, _) => Err(CliError::new(
            "float samples are for TIFF",
            path.display(),
            "name a .tif file, or leave --float out: .npy is float as it is",
        )),
    }
}
