//! Restored colours against true ones: both in files, in linear light.

mod doubts;

use super::perceptual::Perceptual;
use crate::error::{CliError, Result};
use crate::report::Report;
use burn::tensor::Device;
use doubts::Doubts;
use palette::color_difference::Ciede2000;
use palette::white_point::D65;
use palette::{IntoColor, Lab, LinSrgb};
use qudi_core::metrics::{colour_psnr, common_gain, gain_aligned_psnr, zipper_error};
use qudi_core::npy::Header;
use qudi_core::{Error, Frame, Size, linear_to_srgb};
use qudi_train::loss::lpips::{Images, PerceptualKind};
use serde_json::json;
use std::fmt::Write;
use std::io::Read;
use std::path::Path;

/// Weights of red, green and blue in the luma that is scored: the shares of a Bayer filter.
const LUMA: [f32; 3] = [0.25, 0.5, 0.25];

/// Scores of one frame.
struct ColourScore {
    /// CPSNR in linear light, after one common gain.
    linear: f64,
    /// CPSNR of sRGB values, after the same gain.
    srgb: f64,
    /// Median of CIEDE2000 over the pixels.
    difference: f64,
    zipper: f64,
    /// PSNR of luma in linear light, after its own gain.
    luma: f64,
    /// LPIPS of sRGB values after the common gain, with AlexNet and VGG16, where their weights are given.
    lpips: [Option<f64>; 2],
}

/// Networks of [`ColourScore::lpips`].
const LPIPS: [PerceptualKind; 2] = [PerceptualKind::LpipsAlex, PerceptualKind::LpipsVgg];

/// Scores the frames of `restored` against the same frames of `truth`, with the weights of LPIPS in the
/// folder `backbones`.
pub(super) fn score_files(
    truth: &Path,
    restored: &Path,
    backbones: Option<&Path>,
    report: &Report,
) -> Result<()> {
    let load = |folder| Perceptual::load(folder, Images::Colour, Device::flex());
    let perceptual = backbones.map(load).transpose()?;
    let [mut truths, mut others] = [truth, restored].map(ColourClip::open);
    let (truths, others) = match (&mut truths, &mut others) {
        (Ok(truths), Ok(others)) => (truths, others),
        (Err(_), _) => return truths.map(drop),
        _ => return others.map(drop),
    };
    if truths.size != others.size || truths.frames != others.frames {
        return Err(CliError::new(
            format!(
                "{} frames of {}, and the truth has {} of {}",
                others.frames, others.size, truths.frames, truths.size
            ),
            restored.display(),
            "restore every frame of the burst that the truth belongs to",
        ));
    }
    let mut scores = Vec::new();
    let mut doubts = Doubts::default();
    for _ in 0..truths.frames {
        let (restored, truth) = (others.next()?, truths.next()?);
        let score = score(&restored, &truth, perceptual.as_ref())?;
        doubts.add(&restored, &truth, score.linear);
        scores.push(score);
    }
    for doubt in doubts.remarks(scores.len()) {
        report.warning(&doubt);
    }
    let mean = |of: fn(&ColourScore) -> f64| {
        scores.iter().map(of).sum::<f64>() / scores.len().max(1) as f64
    };
    let (linear, srgb) = (mean(|s| s.linear), mean(|s| s.srgb));
    let (difference, zipper) = (mean(|s| s.difference), mean(|s| s.zipper));
    let luma = mean(|s| s.luma);
    let [alex, vgg] = [0, 1].map(|n| {
        let values: Option<Vec<f64>> = scores.iter().map(|score| score.lpips[n]).collect();
        values.map(|values| values.iter().sum::<f64>() / scores.len().max(1) as f64)
    });
    let mut text = String::new();
    let _ = writeln!(text, "{} frames, means:", scores.len());
    for (name, value) in [
        ("CPSNR, linear light", format!("{linear:.2} dB")),
        ("CPSNR, sRGB", format!("{srgb:.2} dB")),
        ("CIEDE2000, median", format!("{difference:.2}")),
        ("zipper error", format!("{zipper:.4}")),
        ("PSNR of luma", format!("{luma:.2} dB")),
    ] {
        let _ = writeln!(text, "  {name:<21}{value}");
    }
    for (name, value) in [("LPIPS (AlexNet)", alex), ("LPIPS (VGG16)", vgg)] {
        if let Some(value) = value {
            let _ = writeln!(text, "  {name:<21}{value:.4}");
        }
    }
    report.result(&text, || {
        json!({
            "frames": scores.len(),
            "cpsnr_linear": linear,
            "cpsnr_srgb": srgb,
            "ciede2000_median": difference,
            "zipper": zipper,
            "psnr_luma": luma,
            "lpips_alex": alex,
            "lpips_vgg": vgg,
        })
    })
}

/// Scores a frame after the best common gain.
fn score(
    restored: &[Frame; 3],
    truth: &[Frame; 3],
    perceptual: Option<&Perceptual>,
) -> Result<ColourScore> {
    let gain = common_gain(restored, truth);
    let mut lpips = [None; 2];
    if let Some(perceptual) = perceptual {
        let (shown, seen) = (encoded(restored, gain as f32), encoded(truth, 1.0));
        for (value, kind) in lpips.iter_mut().zip(LPIPS) {
            *value = perceptual.distance_of_planes(kind, shown.each_ref(), seen.each_ref())?;
        }
    }
    Ok(ColourScore {
        linear: colour_psnr(restored, truth, gain, |value| value),
        srgb: colour_psnr(restored, truth, gain, linear_to_srgb),
        difference: median_difference(restored, truth, gain as f32),
        zipper: zipper_error(restored, truth, gain),
        luma: gain_aligned_psnr(&luma(restored), &luma(truth)),
        lpips,
    })
}

/// Returns sRGB values of linear light, which is multiplied with `gain` and clipped.
fn encoded(planes: &[Frame; 3], gain: f32) -> [Frame; 3] {
    planes.each_ref().map(|plane| {
        let value = |value: &f32| linear_to_srgb((gain * value).clamp(0.0, 1.0));
        Frame { size: plane.size, data: plane.data.iter().map(value).collect() }
    })
}

fn luma(planes: &[Frame; 3]) -> Frame {
    let size = planes[0].size;
    let value = |i: usize| (0..3).map(|k| LUMA[k] * planes[k].data[i]).sum();
    Frame { size, data: (0..size.pixels()).map(value).collect() }
}

/// Returns the median of CIEDE2000 over the pixels; `restored` is multiplied with `gain`.
fn median_difference(restored: &[Frame; 3], truth: &[Frame; 3], gain: f32) -> f64 {
    let lab = |planes: &[Frame; 3], i: usize, gain: f32| -> Lab<D65, f32> {
        let [r, g, b] = planes.each_ref().map(|plane| (gain * plane.data[i]).clamp(0.0, 1.0));
        LinSrgb::new(r, g, b).into_color()
    };
    let pixels = truth[0].size.pixels();
    let difference = |i: usize| lab(restored, i, gain).difference(lab(truth, i, 1.0));
    let mut all: Vec<f32> = (0..pixels).map(difference).collect();
    all.sort_by(f32::total_cmp);
    f64::from(all[pixels / 2])
}

/// A `.npy` of frames of red, green and blue.
struct ColourClip {
    reader: Box<dyn Read>,
    header: Header,
    frames: usize,
    size: Size,
    path: String,
}

impl ColourClip {
    fn open(path: &Path) -> Result<Self> {
        let (header, reader) = Header::open(path)?;
        let &[frames, height, width, 3] = header.shape.as_slice() else {
            return Err(Error::data(
                format!("an array of shape {:?} holds no colour frames", header.shape),
                path,
                "colours are a .npy of shape (frames, height, width, 3), as `qudi restore` and `qudi simulate --truth` write",
            )
            .into());
        };
        let size = Size::new(height, width, &path.display().to_string())?;
        let reader = header.in_c_order(reader, path)?;
        Ok(Self { reader, header, frames, size, path: path.display().to_string() })
    }

    fn next(&mut self) -> Result<[Frame; 3]> {
        let bytes = self.header.sample.bytes();
        let mut raw = vec![0u8; 3 * self.size.pixels() * bytes];
        self.reader
            .read_exact(&mut raw)
            .map_err(|e| Error::io("read a frame", Path::new(&self.path), e))?;
        let values: Vec<f32> =
            raw.chunks_exact(bytes).map(|sample| self.header.sample.decode(sample)).collect();
        if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
            return Err(CliError::new(
                format!("a value of {bad}"),
                &self.path,
                "write frames whose values are finite",
            ));
        }
        Ok(std::array::from_fn(|k| {
            let data = values.iter().skip(k).step_by(3).copied().collect();
            Frame { size: self.size, data }
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sharma et al. 2005, table 1, use Lab values; here, known colours of sRGB.
    #[test]
    fn differences_are_those_of_ciede2000() {
        let size = Size { height: 1, width: 1 };
        let planes = |rgb: [f32; 3]| rgb.map(|v| Frame::filled(size, v));
        let difference = |a, b| median_difference(&planes(a), &planes(b), 1.0);
        assert!(difference([0.2, 0.3, 0.4], [0.2, 0.3, 0.4]) < 1e-3);
        // White and black differ by 100.
        assert!((difference([1.0; 3], [0.0; 3]) - 100.0).abs() < 0.1);
        // Red and green: 86.6 (colormath, scikit-image).
        let red_green = difference([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
        assert!((red_green - 86.6).abs() < 0.3, "{red_green}");
    }
}
