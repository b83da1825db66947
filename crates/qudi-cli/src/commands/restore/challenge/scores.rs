//! The measures of the Single Photon Challenge: PSNR, SSIM and LPIPS of 8-bit sRGB pictures in colour, their
//! means, and their quantiles on the side of the worse pictures.

use super::perceptual::Perceptual;
use crate::error::Result;
use image::RgbImage;
use qudi_core::metrics::gaussian_ssim;
use qudi_core::{Frame, Size};
use serde_json::{Value, json};
use std::fmt::Write;

/// Shares of worse pictures whose quantiles are listed next to the mean, with names for tables and for JSON.
const QUANTILES: [(&str, &str, f64); 3] = [
    ("worst 5 %", "worst_5_percent", 0.05),
    ("worst 1 %", "worst_1_percent", 0.01),
    ("worst", "worst", 0.0),
];

/// The scores of one picture.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Score {
    name: String,
    psnr: f64,
    /// None for pictures smaller than the window.
    ssim: Option<f64>,
    /// None without its weights, and for pictures that are too small.
    lpips: Option<f64>,
}

/// A measure of all pictures.
struct Measure {
    name: &'static str,
    digits: usize,
    /// The values, the worst one first.
    values: Vec<f64>,
}

impl Score {
    /// Compares a picture with the truth, which has its size.
    ///
    /// # Errors
    /// [`CliError`](crate::error::CliError) if the device of LPIPS fails.
    pub(super) fn new(
        name: &str,
        picture: &RgbImage,
        truth: &RgbImage,
        perceptual: Option<&Perceptual>,
    ) -> Result<Self> {
        let pairs = picture.as_raw().iter().zip(truth.as_raw());
        let squares: f64 = pairs.map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum();
        let error = squares / picture.as_raw().len() as f64 / 255.0 / 255.0;
        let ssim: Option<Vec<f64>> =
            (0..3).map(|c| gaussian_ssim(&plane(picture, c), &plane(truth, c))).collect();
        let lpips = perceptual.map(|perceptual| perceptual.distance(picture, truth)).transpose()?;
        Ok(Self {
            name: name.to_owned(),
            psnr: -10.0 * error.log10(),
            ssim: ssim.map(|ssim| ssim.iter().sum::<f64>() / 3.0),
            lpips: lpips.flatten(),
        })
    }
}

/// Returns one colour of a picture, from 0 to 1.
fn plane(picture: &RgbImage, colour: usize) -> Frame {
    let size = Size { height: picture.height() as usize, width: picture.width() as usize };
    let values = picture.as_raw().iter().skip(colour).step_by(3);
    Frame { size, data: values.map(|&value| f32::from(value) / 255.0).collect() }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Returns the value before which a share of the sorted values lies, as `numpy.quantile` does.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (low, high) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    if low == high { low } else { low + (high - low) * place.fract() }
}

/// Returns the measures that all pictures have.
fn measures(scores: &[Score]) -> Vec<Measure> {
    let all = |of: fn(&Score) -> Option<f64>| scores.iter().map(of).collect::<Option<Vec<_>>>();
    let measure = |name, digits, values: Option<Vec<f64>>| {
        Some(Measure { name, digits, values: values.filter(|values| !values.is_empty())? })
    };
    let mut measures: Vec<_> = [
        measure("psnr", 2, all(|score| Some(score.psnr))),
        measure("ssim", 4, all(|score| score.ssim)),
        measure("lpips", 4, all(|score| score.lpips)),
    ]
    .into_iter()
    .flatten()
    .collect();
    for Measure { name, values, .. } in &mut measures {
        values.sort_by(f64::total_cmp);
        // Less is better.
        if *name == "lpips" {
            values.reverse();
        }
    }
    measures
}

/// Describes the scores in a table, with lines that are indented; nothing without scores.
pub(super) fn describe(scores: &[Score]) -> String {
    let mut text = String::new();
    if scores.is_empty() {
        return text;
    }
    let _ = write!(text, "  {:<12}{:>9}", "", "mean");
    for (name, ..) in QUANTILES {
        let _ = write!(text, "{name:>11}");
    }
    for Measure { name, digits, values } in measures(scores) {
        let _ = write!(text, "\n  {name:<12}{:>9.digits$}", mean(&values));
        for (.., share) in QUANTILES {
            let _ = write!(text, "{:>11.digits$}", quantile(&values, share));
        }
    }
    text.push('\n');
    text
}

/// Returns the scores for `--json`: of all pictures together, and of each.
pub(super) fn document(scores: &[Score]) -> Value {
    let mut document = json!({});
    for Measure { name, values, .. } in measures(scores) {
        document[name] = json!({"mean": mean(&values)});
        for (_, key, share) in QUANTILES {
            document[name][key] = json!(quantile(&values, share));
        }
    }
    let of = |score: &Score| {
        let Score { name, psnr, ssim, lpips } = score;
        json!({"name": name, "psnr": psnr, "ssim": ssim, "lpips": lpips})
    };
    document["pictures"] = scores.iter().map(of).collect();
    document
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(shift: u8) -> RgbImage {
        RgbImage::from_fn(16, 12, |x, y| image::Rgb([x as u8 * 9, y as u8 * 15, 40 + shift]))
    }

    #[test]
    fn all_colours_count() {
        let new = |picture: &RgbImage, truth: &RgbImage| {
            Score::new("a/0", picture, truth, None).unwrap_or_else(|e| panic!("{e:?}"))
        };
        let score = new(&picture(3), &picture(0));
        // One of three colours is 3 of 255 off: the mean of the squares is 9 / 3 / 255^2.
        assert!((score.psnr - 10.0 * (255.0f64 * 255.0 / 3.0).log10()).abs() < 1e-9, "{score:?}");
        assert!(score.ssim.is_some_and(|ssim| ssim > 0.9 && ssim < 1.0), "{score:?}");
        let equal = new(&picture(0), &picture(0));
        assert_eq!((equal.psnr, equal.ssim), (f64::INFINITY, Some(1.0)));
        let small = RgbImage::new(8, 8);
        assert_eq!(new(&small, &small).ssim, None);
    }

    #[test]
    fn quantiles_are_numpys() {
        let values: Vec<f64> = (0..11).map(f64::from).collect();
        assert_eq!(quantile(&values, 0.05), 0.5);
        assert_eq!((quantile(&values, 0.0), quantile(&values, 1.0)), (0.0, 10.0));
        assert_eq!(quantile(&[f64::INFINITY; 2], 0.05), f64::INFINITY);
    }

    #[test]
    fn scores_are_described_where_there_are_any() {
        assert_eq!(describe(&[]), "");
        let score = |psnr| {
            let (ssim, lpips) = (Some(0.5), Some(psnr / 100.0));
            Score { name: "a/0".to_owned(), psnr, ssim, lpips }
        };
        let text = describe(&[score(20.0), score(30.0)]);
        assert_eq!(
            text.lines()
                .map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "))
                .collect::<Vec<_>>(),
            [
                "mean worst 5 % worst 1 % worst",
                "psnr 25.00 20.50 20.10 20.00",
                "ssim 0.5000 0.5000 0.5000 0.5000",
                "lpips 0.2500 0.2950 0.2990 0.3000"
            ]
        );
        assert_eq!(document(&[score(20.0)])["psnr"]["worst"], 20.0);
        let without = [Score { lpips: None, ..score(20.0) }];
        assert!(!describe(&without).contains("lpips") && document(&without)["lpips"].is_null());
    }
}
