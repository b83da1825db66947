//! The registry of metrics: one row each. Tables, CSV, JSON, the page and `--min-psnr` are read from it.

use super::appearance::{butteraugli, shown, ssimulacra2};
use super::perceptual::Perceptual;
use crate::error::{CliError, Result};
use qudi_core::Frame;
use qudi_core::metrics::{
    best_gain, calibration, detail, gain_aligned_psnr, gaussian_ssim, gmsd, psnr, ssim,
};
use qudi_train::loss::lpips::PerceptualKind;

/// A metric of single frames.
pub(crate) struct Metric {
    /// Name in CSV and JSON.
    pub(crate) key: &'static str,
    /// Name in tables.
    pub(crate) title: &'static str,
    /// Digits after the point in tables.
    pub(crate) digits: usize,
    pub(crate) better: Better,
    pub(crate) part: Part,
    /// Computes the metric; none where an input is missing.
    pub(crate) value: fn(&Compared<'_>) -> Result<Option<f64>>,
}

/// Direction in which a metric improves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Better {
    Higher,
    Lower,
    /// As close to one as possible.
    One,
}

/// Tables that a metric is part of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The summary, with the centre, all frames, and the worst ones.
    Lead,
    /// The summary, with a confidence interval.
    Summary,
    /// The summary, and the table of appearance.
    Both,
    /// The table of appearance.
    Appearance,
    /// Single frames: its value for a clip is no mean over frames.
    Frames,
}

/// A restored frame, and what it is compared with.
pub(crate) struct Compared<'a> {
    pub(crate) image: &'a Frame,
    pub(crate) truth: &'a Frame,
    /// The image after the gain that brings it closest to the truth, clipped.
    pub(crate) aligned: Frame,
    /// Predicted standard deviation of the errors, after the same gain.
    pub(crate) sigma: Option<Frame>,
    pub(crate) chi_square: Option<f64>,
    pub(crate) perceptual: Option<&'a Perceptual>,
    /// True if appearance is measured.
    pub(crate) appearance: bool,
    /// Name of the clip, for errors.
    pub(crate) clip: &'a str,
}

pub(crate) const PSNR_A: Metric =
    Metric::new("psnr_a", "psnr-a", 2, Better::Higher, Part::Lead, |c| {
        Ok(Some(gain_aligned_psnr(c.image, c.truth)))
    });

pub(crate) const PSNR: Metric =
    Metric::new("psnr", "psnr", 2, Better::Higher, Part::Summary, |c| {
        Ok(Some(psnr(c.image, c.truth)))
    });

pub(crate) const SSIM: Metric =
    Metric::new("ssim", "ssim", 3, Better::Higher, Part::Summary, |c| {
        ssim(c.image, c.truth).map(Some).ok_or_else(|| c.too_small())
    });

pub(crate) const LPIPS_ALEX: Metric =
    Metric::new("lpips_alex", "lpips-alex", 3, Better::Lower, Part::Both, |c| {
        c.lpips(PerceptualKind::LpipsAlex)
    });

pub(crate) const LPIPS_VGG: Metric =
    Metric::new("lpips_vgg", "lpips-vgg", 3, Better::Lower, Part::Both, |c| {
        c.lpips(PerceptualKind::LpipsVgg)
    });

pub(crate) const GMSD: Metric =
    Metric::new("gmsd", "gmsd", 4, Better::Lower, Part::Appearance, |c| {
        Ok(shown(c)?.and_then(|c| gmsd(&c.aligned, c.truth)))
    });

pub(crate) const CHI_SQUARE: Metric =
    Metric::new("chi_square", "chi-square", 3, Better::One, Part::Frames, |c| Ok(c.chi_square));

/// All metrics, in the order of tables.
pub(crate) const METRICS: &[Metric] = &[
    PSNR_A,
    PSNR,
    SSIM,
    Metric::new("ssim_g", "ssim-g", 3, Better::Higher, Part::Summary, |c| {
        gaussian_ssim(c.image, c.truth).map(Some).ok_or_else(|| c.too_small())
    }),
    LPIPS_ALEX,
    LPIPS_VGG,
    GMSD,
    Metric::new("ssimulacra2", "ssimulacra2", 2, Better::Higher, Part::Appearance, |c| {
        shown(c)?.map(|c| ssimulacra2(&c.aligned, c.truth)).transpose()
    }),
    Metric::new("butteraugli", "butteraugli", 2, Better::Lower, Part::Appearance, |c| {
        shown(c)?.map(|c| butteraugli(&c.aligned, c.truth)).transpose()
    }),
    Metric::new("detail_flat", "detail flat", 2, Better::One, Part::Appearance, |c| {
        Ok(shown(c)?.and_then(|c| Some(detail(&c.aligned, c.truth)?.flat)))
    }),
    Metric::new("detail_textured", "detail textured", 2, Better::One, Part::Appearance, |c| {
        Ok(shown(c)?.and_then(|c| Some(detail(&c.aligned, c.truth)?.textured)))
    }),
    Metric::new("error_over_sigma", "error/sigma", 2, Better::One, Part::Appearance, |c| {
        Ok(shown(c)?.and_then(|c| Some(calibration(&c.aligned, c.sigma.as_ref()?, c.truth)?.all)))
    }),
    Metric::new("error_over_sigma_flat", "flat", 2, Better::One, Part::Appearance, |c| {
        Ok(shown(c)?.and_then(|c| Some(calibration(&c.aligned, c.sigma.as_ref()?, c.truth)?.flat)))
    }),
    Metric::new("error_over_sigma_textured", "textured", 2, Better::One, Part::Appearance, |c| {
        let found = |c: &Compared<'_>| calibration(&c.aligned, c.sigma.as_ref()?, c.truth);
        Ok(shown(c)?.and_then(found).map(|found| found.textured))
    }),
    CHI_SQUARE,
];

impl Metric {
    const fn new(
        key: &'static str,
        title: &'static str,
        digits: usize,
        better: Better,
        part: Part,
        value: fn(&Compared<'_>) -> Result<Option<f64>>,
    ) -> Self {
        Self { key, title, digits, better, part, value }
    }

    /// Returns true if the table of appearance shows it.
    pub(crate) fn is_appearance(&self) -> bool {
        matches!(self.part, Part::Both | Part::Appearance)
    }

    /// Returns true if `value` is worse than `bar`, or no number.
    pub(crate) fn misses(&self, value: f64, bar: f64) -> bool {
        let is_worse = match self.better {
            Better::Higher => value < bar,
            Better::Lower => value > bar,
            Better::One => (value - 1.0).abs() > (bar - 1.0).abs(),
        };
        !value.is_finite() || is_worse
    }
}

impl<'a> Compared<'a> {
    /// Compares a restored frame with the truth, for metrics that take nothing else.
    pub(crate) fn new(image: &'a Frame, truth: &'a Frame, clip: &'a str) -> Self {
        Self {
            image,
            truth,
            aligned: aligned(image, truth),
            sigma: None,
            chi_square: None,
            perceptual: None,
            appearance: false,
            clip,
        }
    }

    /// Adds the predicted standard deviation of the image's errors.
    pub(crate) fn with_sigma(self, sigma: Option<&Frame>) -> Self {
        let gain = best_gain(self.image, self.truth);
        Self { sigma: sigma.map(|sigma| times(sigma, gain)), ..self }
    }

    fn lpips(&self, kind: PerceptualKind) -> Result<Option<f64>> {
        match self.perceptual {
            Some(perceptual) => perceptual.distance(kind, &self.aligned, self.truth),
            None => Ok(None),
        }
    }

    fn too_small(&self) -> CliError {
        let size = self.truth.size;
        CliError::new(
            format!("frames of {size} are smaller than SSIM's window of 11 x 11"),
            self.clip,
            "use larger frames",
        )
    }
}

/// Returns a restored frame after the gain that brings it closest to the truth.
pub(crate) fn aligned(image: &Frame, truth: &Frame) -> Frame {
    scaled(image, best_gain(image, truth))
}

/// Multiplies a frame by a factor and clips it to [0, 1].
pub(crate) fn scaled(image: &Frame, gain: f64) -> Frame {
    let mut frame = times(image, gain);
    frame.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    frame
}

fn times(image: &Frame, factor: f64) -> Frame {
    let data = image.data.iter().map(|v| v * factor as f32).collect();
    Frame { size: image.size, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_unique_and_bars_follow_the_direction() {
        for (n, metric) in METRICS.iter().enumerate() {
            assert!(METRICS[..n].iter().all(|other| other.key != metric.key), "{}", metric.key);
        }
        assert!(PSNR_A.misses(9.9, 10.0) && !PSNR_A.misses(10.0, 10.0));
        assert!(GMSD.misses(0.2, 0.1) && CHI_SQUARE.misses(0.5, 1.2));
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(METRICS.iter().all(|metric| metric.misses(value, 0.0)));
        }
    }
}
