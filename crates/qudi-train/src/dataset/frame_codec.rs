//! Coding of a pack's frames: gray JPEG for training, gray PNG for validation.
//!
//! JPEG has one quantization step for all frequencies instead of the usual tables, which remove fine texture:
//! texture is what a network has to learn. The root-mean-square error is about [`STEP`] / sqrt(12) = 3.8 of
//! 255 in the finest texture, and less where coefficients are small; photon noise at 30 photons per pixel is
//! six times as much at mid-gray.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageFormat, ImageReader, Limits};
use jpeg_encoder::{ColorType, Encoder, QuantizationTableType};
use qudi_core::{Error, Result, Size};
use std::io::Cursor;

/// Quantization step of every DCT coefficient, in gray values.
const STEP: u16 = 13;

/// Coding of a clip's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FrameCodec {
    Jpeg,
    Png,
}

impl FrameCodec {
    /// Returns the extension of entries.
    pub(super) fn extension(self) -> &'static str {
        match self {
            Self::Jpeg => "jpg",
            Self::Png => "png",
        }
    }

    /// Encodes a gray image.
    pub(super) fn encode(self, values: &[u8], size: Size) -> Result<Vec<u8>> {
        let fault = |e: &dyn std::fmt::Display| {
            let help = "shrink the source, or leave it out";
            Error::request(format!("a frame cannot be encoded: {e}"), size, help)
        };
        let mut bytes = Vec::new();
        match self {
            Self::Jpeg => {
                let side = |length: usize| u16::try_from(length).map_err(|e| fault(&e));
                let (width, height) = (side(size.width)?, side(size.height)?);
                let mut encoder = Encoder::new(&mut bytes, 100);
                let table = || QuantizationTableType::Custom(Box::new([STEP; 64]));
                encoder.set_quantization_tables(table(), table());
                encoder.set_optimized_huffman_tables(true);
                encoder.encode(values, width, height, ColorType::Luma).map_err(|e| fault(&e))?;
            }
            Self::Png => {
                let (kind, filter) = (CompressionType::Best, FilterType::Adaptive);
                let encoder = PngEncoder::new_with_quality(&mut bytes, kind, filter);
                let (width, height) = (size.width as u32, size.height as u32);
                let done = encoder.write_image(values, width, height, ExtendedColorType::L8);
                done.map_err(|e| fault(&e))?;
            }
        }
        Ok(bytes)
    }

    /// Decodes a gray image of a known size; otherwise says what is wrong.
    pub(super) fn decode(self, bytes: &[u8], size: Size) -> Result<Vec<u8>, String> {
        let format = match self {
            Self::Jpeg => ImageFormat::Jpeg,
            Self::Png => ImageFormat::Png,
        };
        let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
        let mut limits = Limits::default();
        (limits.max_image_height, limits.max_image_width) =
            (Some(size.height as u32), Some(size.width as u32));
        reader.limits(limits);
        let image = reader.decode().map_err(|e| e.to_string())?.into_luma8();
        if (image.height() as usize, image.width() as usize) != (size.height, size.width) {
            return Err("it has another size than its clip".into());
        }
        Ok(image.into_raw())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// Noise of one level, the hardest image: the loss is what the module says. PNG loses nothing.
    #[test]
    fn jpeg_keeps_fine_texture() {
        let size = Size { height: 61, width: 83 };
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        for amplitude in [8u8, 40, 127] {
            let values: Vec<u8> = (0..size.pixels())
                .map(|_| {
                    (128 - u16::from(amplitude) + u16::from(random()) * u16::from(amplitude) / 128)
                        as u8
                })
                .collect();
            let error = |codec: FrameCodec| {
                let bytes = codec.encode(&values, size).unwrap();
                let decoded = codec.decode(&bytes, size).unwrap();
                let pairs = values.iter().zip(&decoded);
                let sum: f64 = pairs.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
                (sum / size.pixels() as f64).sqrt()
            };
            assert!(error(FrameCodec::Jpeg) < 4.2, "{amplitude}: {}", error(FrameCodec::Jpeg));
            assert_eq!(error(FrameCodec::Png), 0.0);
        }
    }

    #[test]
    fn rejects_images_of_another_size_and_no_images() {
        let size = Size { height: 9, width: 11 };
        for codec in [FrameCodec::Jpeg, FrameCodec::Png] {
            let bytes = codec.encode(&[77; 99], size).unwrap();
            for other in [Size { height: 8, width: 11 }, Size { height: 9, width: 12 }] {
                assert!(codec.decode(&bytes, other).is_err());
            }
            for length in 0..bytes.len() / 2 {
                assert!(codec.decode(&bytes[..length], size).is_err(), "{codec:?}: {length}");
            }
        }
        let wide = Size { height: 1, width: 70_000 };
        assert!(FrameCodec::Jpeg.encode(&vec![0; 70_000], wide).is_err());
    }
}
