//! Meaning of the numbers of an image file: display values or linear light.

use serde::{Deserialize, Serialize};

/// Conversion of file values into the scene's radiance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transfer {
    /// Take the values as they are (the field's protocol: display-referred values are the flux).
    #[default]
    AsIs,
    /// Decode sRGB to linear light first, as a camera in front of the scene would see it.
    Srgb,
    /// Take one plane, red, green or blue, in place of gray: as it is, or decoded to linear light.
    #[serde(skip)]
    Plane {
        /// Index of the plane.
        index: usize,
        /// True to decode sRGB.
        decodes: bool,
    },
}

impl Transfer {
    /// Converts a file value into radiance in [0, 1].
    pub fn decode(self, value: f32) -> f32 {
        match self {
            Self::AsIs | Self::Plane { decodes: false, .. } => value,
            Self::Srgb | Self::Plane { decodes: true, .. } => srgb_to_linear(value),
        }
    }

    /// Returns true if values are decoded from sRGB.
    pub fn decodes(self) -> bool {
        matches!(self, Self::Srgb | Self::Plane { decodes: true, .. })
    }

    /// Computes gray from R, G, B in [0, 1]: BT.601 luma of the values as they are, the luminance of BT.709
    /// primaries in linear light, or one plane.
    pub fn gray(self, rgb: [f32; 3]) -> f32 {
        let [r, g, b] = rgb;
        match self {
            Self::Plane { index, .. } => self.decode(rgb[index]),
            Self::AsIs => 0.299 * r + 0.587 * g + 0.114 * b,
            Self::Srgb => {
                0.2126 * srgb_to_linear(r) + 0.7152 * srgb_to_linear(g) + 0.0722 * srgb_to_linear(b)
            }
        }
    }
}

/// Decodes sRGB (IEC 61966-2-1).
pub fn srgb_to_linear(v: f32) -> f32 {
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Encodes sRGB (IEC 61966-2-1).
pub fn linear_to_srgb(v: f32) -> f32 {
    if v <= 0.003_130_8 { v * 12.92 } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_decoding_matches_the_standard_and_inverts() {
        assert!((srgb_to_linear(0.5) - 0.214_041_14).abs() < 1e-6);
        for i in 0..=255u8 {
            let v = f32::from(i) / 255.0;
            assert!((linear_to_srgb(srgb_to_linear(v)) - v).abs() < 1e-5, "{i}");
        }
    }

    #[test]
    fn gray_of_a_gray_image_is_unchanged() {
        for transfer in [Transfer::AsIs, Transfer::Srgb] {
            assert!((transfer.gray([0.4; 3]) - transfer.decode(0.4)).abs() < 1e-6);
        }
    }
}
