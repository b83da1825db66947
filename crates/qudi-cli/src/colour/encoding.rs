//! Colour frames in files: linear light where values are measured, sRGB where pictures are shown.

use qudi_core::{Frame, linear_to_srgb};
use qudi_io::writer::TiffSamples;
use std::path::Path;

/// Returns true for files that hold colours in linear light: `.npy`, and `.tif` of float samples.
pub(crate) fn is_linear(path: &Path, tiff: TiffSamples) -> bool {
    match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
        Some("npy") => true,
        Some("tif" | "tiff") => tiff == TiffSamples::F32,
        _ => false,
    }
}

/// Encodes linear light as sRGB.
pub(crate) fn encoded(planes: &[Frame; 3]) -> [Frame; 3] {
    planes.each_ref().map(|plane| {
        let data = plane.data.iter().map(|value| linear_to_srgb(value.max(0.0))).collect();
        Frame { size: plane.size, data }
    })
}
