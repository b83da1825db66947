//! Metrics of appearance that need no weights. Both frames are taken as images on a screen (sRGB).

use super::metrics::Compared;
use crate::error::{CliError, Result};
use butteraugli::{ButteraugliParams, Img, RGB8};
use qudi_core::Frame;
use ssimulacra2::{ColorPrimaries, Rgb, TransferCharacteristic, compute_frame_ssimulacra2};

/// Smallest side of frames that all metrics support.
const MIN_SIDE: usize = 32;

/// Returns the frames if appearance is measured.
///
/// # Errors
/// [`CliError`] if they are too small.
pub(super) fn shown<'a, 'b>(compared: &'a Compared<'b>) -> Result<Option<&'a Compared<'b>>> {
    let size = compared.truth.size;
    if compared.appearance && size.height.min(size.width) < MIN_SIDE {
        return Err(unfit(format!("frames of {size} are smaller than {MIN_SIDE} x {MIN_SIDE}")));
    }
    Ok(compared.appearance.then_some(compared))
}

/// Computes SSIMULACRA 2: 100 for equal images, below 0 for very bad ones.
pub(super) fn ssimulacra2(image: &Frame, truth: &Frame) -> Result<f64> {
    let failed = |e: &dyn std::fmt::Display| unfit(format!("SSIMULACRA 2: {e}"));
    let colours = |frame: &Frame| {
        let pixels = frame.data.iter().map(|&v| [v.clamp(0.0, 1.0); 3]).collect();
        let (width, height) = (frame.size.width, frame.size.height);
        Rgb::new(pixels, width, height, TransferCharacteristic::SRGB, ColorPrimaries::BT709)
            .map_err(|e| failed(&e))
    };
    compute_frame_ssimulacra2(colours(truth)?, colours(image)?).map_err(|e| failed(&e))
}

/// Computes butteraugli: 0 for equal images.
pub(super) fn butteraugli(image: &Frame, truth: &Frame) -> Result<f64> {
    let bytes = |frame: &Frame| -> Img<Vec<RGB8>> {
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let pixels = frame.data.iter().map(|&v| RGB8::from([byte(v); 3])).collect();
        Img::new(pixels, frame.size.width, frame.size.height)
    };
    let (image, truth) = (bytes(image), bytes(truth));
    butteraugli::butteraugli(truth.as_ref(), image.as_ref(), &ButteraugliParams::default())
        .map(|distance| distance.score)
        .map_err(|e| unfit(format!("butteraugli: {e}")))
}

fn unfit(why: String) -> CliError {
    CliError::new(why, "--appearance", "use larger frames, or leave it out")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::eval::metrics::METRICS;
    use qudi_core::Size;

    fn image(contrast: f32, grain: f32) -> Frame {
        Frame::from_fn(Size { height: 64, width: 80 }, |x, y| {
            let stripes = ((x / 3 + y / 5) % 2) as f32 - 0.5;
            let noise = ((x * 31 + y * 17) % 23) as f32 / 23.0 - 0.5;
            0.5 + contrast * stripes * x as f32 / 80.0 + grain * noise
        })
    }

    /// Returns the values of GMSD, SSIMULACRA 2, butteraugli and detail in the flattest quarter, no gain
    /// applied.
    fn values(image: &Frame, truth: &Frame) -> Result<Vec<f64>> {
        let compared = Compared {
            aligned: image.clone(),
            appearance: true,
            ..Compared::new(image, truth, "clip")
        };
        let keys = ["gmsd", "ssimulacra2", "butteraugli", "detail_flat"];
        let metrics = keys.map(|key| METRICS.iter().find(|metric| metric.key == key).unwrap());
        metrics.iter().map(|metric| Ok((metric.value)(&compared)?.unwrap())).collect()
    }

    #[test]
    fn equal_images_look_alike_and_damage_is_seen_by_all_metrics() {
        let of = |image: &Frame, truth: &Frame| values(image, truth).unwrap();
        let truth = image(0.6, 0.0);
        let same = of(&truth, &truth);
        assert!(same[0] == 0.0 && (same[1] - 100.0).abs() < 0.01, "{same:?}");
        assert!(same[2] < 0.01 && same[3] == 1.0, "{same:?}");
        let (mild, strong) = (of(&image(0.6, 0.05), &truth), of(&image(0.4, 0.3), &truth));
        for (better, worse) in [(&same, &mild), (&mild, &strong)] {
            assert!(better[0] < worse[0] && better[2] < worse[2], "{better:?} {worse:?}");
            assert!(better[1] > worse[1], "{better:?} {worse:?}");
        }
    }

    #[test]
    fn frames_that_are_too_small_are_refused() {
        let tiny = Frame::filled(Size { height: 16, width: 64 }, 0.5);
        let error = values(&tiny, &tiny).expect_err("too small");
        assert!(format!("{error:?}").contains("32 x 32"));
    }
}
