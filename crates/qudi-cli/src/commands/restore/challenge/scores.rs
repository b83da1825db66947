//! The measures of the Single Photon Challenge: PSNR and SSIM of 8-bit sRGB pictures in colour, their means,
//! and their low quantiles. LPIPS, the third one, needs weights that are not in the program.

use image::RgbImage;
use qudi_core::metrics::gaussian_ssim;
use qudi_core::{Frame, Size};
use serde_json::{Value, json};
use std::fmt::Write;

/// Quantiles that the challenge lists next to the mean, with their names.
const QUANTILES: [(&str, f64); 3] = [("5 % low", 0.05), ("1 % low", 0.01), ("lowest", 0.0)];

/// The scores of one picture.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Score {
    name: String,
    psnr: f64,
    /// None for pictures smaller than the window.
    ssim: Option<f64>,
}

impl Score {
    /// Compares a picture with the truth, which has its size.
    pub(super) fn new(name: &str, picture: &RgbImage, truth: &RgbImage) -> Self {
        let pairs = picture.as_raw().iter().zip(truth.as_raw());
        let squares: f64 = pairs.map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum();
        let error = squares / picture.as_raw().len() as f64 / 255.0 / 255.0;
        let ssim: Option<Vec<f64>> =
            (0..3).map(|c| gaussian_ssim(&plane(picture, c), &plane(truth, c))).collect();
        Self {
            name: name.to_owned(),
            psnr: -10.0 * error.log10(),
            ssim: ssim.map(|ssim| ssim.iter().sum::<f64>() / 3.0),
        }
    }
}

/// Returns one colour of a picture, from 0 to 1.
fn plane(picture: &RgbImage, colour: usize) -> Frame {
    let size = Size { height: picture.height() as usize, width: picture.width() as usize };
    let values = picture.as_raw().iter().skip(colour).step_by(3);
    Frame { size, data: values.map(|&value| f32::from(value) / 255.0).collect() }
}

/// Returns the value below which a share of the sorted values lies, as `numpy.quantile` does.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (low, high) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    if low == high { low } else { low + (high - low) * place.fract() }
}

/// Returns the measures that all pictures have, by name, with the sorted values.
fn measures(scores: &[Score]) -> Vec<(&'static str, Vec<f64>)> {
    let psnr = Some(scores.iter().map(|score| score.psnr).collect());
    let ssim = scores.iter().map(|score| score.ssim).collect();
    let measures: [(_, Option<Vec<f64>>); 2] = [("psnr", psnr), ("ssim", ssim)];
    let mut measures: Vec<_> =
        measures.into_iter().filter_map(|(name, values)| Some((name, values?))).collect();
    for (_, values) in &mut measures {
        values.sort_by(f64::total_cmp);
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
    for (name, _) in QUANTILES {
        let _ = write!(text, "{name:>9}");
    }
    for (name, values) in measures(scores) {
        let digits = if name == "psnr" { 2 } else { 4 };
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let _ = write!(text, "\n  {name:<12}{mean:>9.digits$}");
        for (_, share) in QUANTILES {
            let _ = write!(text, "{:>9.digits$}", quantile(&values, share));
        }
    }
    text.push('\n');
    text
}

/// Returns the scores for `--json`: of all pictures together, and of each.
pub(super) fn document(scores: &[Score]) -> Value {
    let mut document = json!({});
    for (name, values) in measures(scores) {
        if values.is_empty() {
            continue;
        }
        document[name] = json!({"mean": values.iter().sum::<f64>() / values.len() as f64});
        for (quantile_name, share) in QUANTILES {
            document[name][quantile_name] = json!(quantile(&values, share));
        }
    }
    let of = |score: &Score| json!({"name": score.name, "psnr": score.psnr, "ssim": score.ssim});
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
        let score = Score::new("a/0", &picture(3), &picture(0));
        // One of three colours is 3 of 255 off: the mean of the squares is 9 / 3 / 255^2.
        assert!((score.psnr - 10.0 * (255.0f64 * 255.0 / 3.0).log10()).abs() < 1e-9, "{score:?}");
        assert!(score.ssim.is_some_and(|ssim| ssim > 0.9 && ssim < 1.0), "{score:?}");
        let equal = Score::new("a/0", &picture(0), &picture(0));
        assert_eq!((equal.psnr, equal.ssim), (f64::INFINITY, Some(1.0)));
        let small = RgbImage::new(8, 8);
        assert_eq!(Score::new("a/0", &small, &small).ssim, None);
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
        let score = |psnr| Score { name: "a/0".to_owned(), psnr, ssim: Some(0.5) };
        let text = describe(&[score(20.0), score(30.0)]);
        assert_eq!(
            text.lines()
                .map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "))
                .collect::<Vec<_>>(),
            [
                "mean 5 % low 1 % low lowest",
                "psnr 25.00 20.50 20.10 20.00",
                "ssim 0.5000 0.5000 0.5000 0.5000"
            ]
        );
        assert_eq!(document(&[score(20.0)])["psnr"]["lowest"], 20.0);
    }
}
