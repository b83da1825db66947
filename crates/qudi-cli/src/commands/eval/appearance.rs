//! How restored frames look beside the truth, by measures that need no weights.

use crate::error::{CliError, Result};
use butteraugli::{ButteraugliParams, Img, RGB8, butteraugli};
use qudi_core::Frame;
use qudi_core::metrics::{detail, gmsd};
use serde::Serialize;
use ssimulacra2::{ColorPrimaries, Rgb, TransferCharacteristic, compute_frame_ssimulacra2};

/// The least side of frames that all measures take.
const LEAST: usize = 32;

/// How a frame looks beside the truth. Both are taken as images on a screen (sRGB).
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Appearance {
    /// Gradient magnitude similarity deviation; 0 for equal images.
    pub(crate) gmsd: f64,
    /// SSIMULACRA 2; 100 for equal images, below 0 for very bad ones.
    pub(crate) ssimulacra2: f64,
    /// Butteraugli; 0 for equal images.
    pub(crate) butteraugli: f64,
    /// Energy of the gradients over the truth's, in the flattest quarter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) detail_flat: Option<f64>,
    /// The same in the most textured quarter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) detail_textured: Option<f64>,
}

impl Appearance {
    /// Compares two frames of one size, in [0, 1].
    ///
    /// # Errors
    /// [`CliError`] if they are too small.
    pub(super) fn of(image: &Frame, truth: &Frame) -> Result<Self> {
        let size = truth.size;
        let unfit =
            |why: String| CliError::new(why, "--appearance", "use larger frames, or leave it out");
        if size.height.min(size.width) < LEAST {
            return Err(unfit(format!("frames of {size} are smaller than {LEAST} x {LEAST}")));
        }
        let colours = |frame: &Frame| {
            let pixels = frame.data.iter().map(|&v| [v.clamp(0.0, 1.0); 3]).collect();
            let (width, height) = (size.width, size.height);
            Rgb::new(pixels, width, height, TransferCharacteristic::SRGB, ColorPrimaries::BT709)
                .map_err(|e| unfit(format!("SSIMULACRA 2: {e}")))
        };
        let bytes = |frame: &Frame| {
            let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
            let pixels = frame.data.iter().map(|&v| RGB8::from([byte(v); 3])).collect();
            Img::new(pixels, size.width, size.height)
        };
        let (shown, true_bytes): (Img<Vec<_>>, Img<Vec<_>>) = (bytes(image), bytes(truth));
        let distance =
            butteraugli(true_bytes.as_ref(), shown.as_ref(), &ButteraugliParams::default())
                .map_err(|e| unfit(format!("butteraugli: {e}")))?;
        let detail = detail(image, truth);
        Ok(Self {
            gmsd: gmsd(image, truth).ok_or_else(|| unfit("frames of two sizes".to_owned()))?,
            ssimulacra2: compute_frame_ssimulacra2(colours(truth)?, colours(image)?)
                .map_err(|e| unfit(format!("SSIMULACRA 2: {e}")))?,
            butteraugli: distance.score,
            detail_flat: detail.map(|detail| detail.flat),
            detail_textured: detail.map(|detail| detail.textured),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    fn image(contrast: f32, grain: f32) -> Frame {
        Frame::from_fn(Size { height: 64, width: 80 }, |x, y| {
            let stripes = ((x / 3 + y / 5) % 2) as f32 - 0.5;
            let noise = ((x * 31 + y * 17) % 23) as f32 / 23.0 - 0.5;
            0.5 + contrast * stripes * x as f32 / 80.0 + grain * noise
        })
    }

    #[test]
    fn equal_images_look_alike_and_damage_is_seen_by_all_measures() {
        let of = |image: &Frame, truth: &Frame| {
            Appearance::of(image, truth).unwrap_or_else(|e| panic!("{e:?}"))
        };
        let truth = image(0.6, 0.0);
        let same = of(&truth, &truth);
        assert!(same.gmsd == 0.0 && same.butteraugli < 0.01, "{same:?}");
        assert!(
            (same.ssimulacra2 - 100.0).abs() < 0.01 && same.detail_flat == Some(1.0),
            "{same:?}"
        );
        let (mild, strong) = (of(&image(0.6, 0.05), &truth), of(&image(0.4, 0.3), &truth));
        for (better, worse) in [(same, mild), (mild, strong)] {
            assert!(better.gmsd < worse.gmsd && better.butteraugli < worse.butteraugli);
            assert!(better.ssimulacra2 > worse.ssimulacra2, "{better:?} {worse:?}");
        }
    }

    #[test]
    fn frames_that_are_too_small_are_refused() {
        let tiny = Frame::filled(Size { height: 16, width: 64 }, 0.5);
        let error = Appearance::of(&tiny, &tiny).expect_err("too small");
        assert!(format!("{error:?}").contains("32 x 32"));
    }
}
