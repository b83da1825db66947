//! The page of `qudi eval`: table, plot, and pictures side by side.

use super::metrics::{CHI_SQUARE, GMSD, LPIPS_ALEX, LPIPS_VGG, Metric, PSNR_A, SSIM};
use super::score::{Row, Score};
use super::table::summary;
use crate::error::Result;
use crate::report::Table;
use crate::report::html::{TableView, crop, crop_size, render};
use crate::report::svg::{Axis, Curve, Drawing, Plot, Point};
use qudi_core::Frame;
use serde::Serialize;
use std::fmt::Write;

/// Largest side of the pictures: a crop from the middle.
const CROP: usize = 224;

/// Errors are shown this many times larger, zero at middle gray.
const ERROR_GAIN: f32 = 2.0;

/// The pictures of a clip at one light level.
pub(crate) struct Pictures {
    pub(crate) clip: String,
    pub(crate) ppp: f64,
    /// Counts of the middle frame, full scale for 1.
    pub(crate) counts: Frame,
    pub(crate) truth: Option<Frame>,
    /// Restored frames by method.
    restored: Vec<(String, Frame)>,
    captions: Vec<String>,
}

/// The context of the template.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    about: &'a str,
    table: TableView,
    /// Further tables.
    looks: Vec<Looks>,
    plots: Vec<Drawing>,
    has_truth: bool,
    clips: Vec<Clip>,
}

/// A further table.
#[derive(Serialize)]
struct Looks {
    title: &'static str,
    table: TableView,
}

/// Pictures of a clip, two of them under a slider.
#[derive(Serialize)]
struct Clip {
    name: String,
    ppp: f64,
    /// Size of the pictures.
    width: usize,
    height: usize,
    /// Size of the frames.
    size: String,
    cropped: bool,
    captions: Vec<String>,
    pictures: Vec<Picture>,
    /// Numbers of the pictures that are shown first.
    left: usize,
    right: usize,
}

#[derive(Serialize)]
struct Picture {
    name: String,
    url: String,
}

impl Pictures {
    pub(crate) fn new(clip: String, ppp: f64, counts: Frame, truth: Option<Frame>) -> Self {
        Self { clip, ppp, counts, truth, restored: Vec::new(), captions: Vec::new() }
    }

    /// Adds the restored frame of a method.
    pub(crate) fn add(&mut self, method: &str, score: &Score) {
        let middle = score.frames.get(score.frames.len() / 2);
        let value = |metric| middle.and_then(|frame| frame.get(metric));
        let mut caption = format!("{method}{}", score.how);
        if let (Some(psnr_a), Some(ssim)) = (value(&PSNR_A), value(&SSIM)) {
            let _ = write!(caption, ": PSNR {psnr_a:.2} dB after the best gain, SSIM {ssim:.3}");
        } else if let Some(chi_square) = value(&CHI_SQUARE) {
            let _ = write!(caption, ": chi-square {chi_square:.3}");
        }
        self.captions.push(caption);
        self.restored.push((method.to_owned(), score.picture.clone()));
    }
}

/// Renders the page.
pub(crate) fn html(
    rows: &[Row],
    further: &[(&'static str, Table)],
    pictures: &[Pictures],
    about: &str,
) -> Result<String> {
    render(
        "eval.html",
        Page {
            title: "Evaluation of methods",
            about,
            table: TableView::from(&summary(rows)),
            looks: further
                .iter()
                .map(|(title, table)| Looks { title, table: TableView::from(table) })
                .collect(),
            plots: [Some(quality(rows)), perception(rows)]
                .into_iter()
                .flatten()
                .filter_map(|plot| plot.draw())
                .collect(),
            has_truth: pictures.iter().any(|clip| clip.truth.is_some()),
            clips: pictures.iter().map(clip).collect(),
        },
    )
}

/// Plots gain-aligned PSNR against light.
fn quality(rows: &[Row]) -> Plot {
    let mut curves: Vec<Curve> = Vec::new();
    for row in rows {
        let Some(psnr_a) = row.over_clips(&PSNR_A) else { continue };
        let point = Point { x: row.ppp, y: psnr_a.mean, error: psnr_a.ci95.unwrap_or(0.0) };
        match curves.iter_mut().find(|curve| curve.name == row.label()) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve { name: row.label(), points: vec![point] }),
        }
    }
    for curve in &mut curves {
        curve.points.sort_by(|a, b| a.x.total_cmp(&b.x));
    }
    let mut levels: Vec<f64> = rows.iter().map(|row| row.ppp).collect();
    levels.sort_by(f64::total_cmp);
    levels.dedup();
    Plot {
        title: "PSNR against light".to_owned(),
        caption: "PSNR after the best gain, all frames, mean over clips; bars show its 95 % confidence interval. \
                  Higher is better."
            .to_owned(),
        x: Axis { ticks: levels, ..Axis::logarithmic("incident photons per pixel and frame") },
        y: Axis::linear("dB"),
        curves,
    }
}

/// Plots perception against distortion (Blau and Michaeli 2018): the numbers of steps of a method as a curve,
/// one for every light level. None where no metric of perception was measured.
fn perception(rows: &[Row]) -> Option<Plot> {
    let metrics: [(&'static str, &Metric); 3] =
        [("LPIPS (VGG)", &LPIPS_VGG), ("LPIPS (Alex)", &LPIPS_ALEX), ("GMSD", &GMSD)];
    let is_known =
        |(_, metric): &&(_, &Metric)| rows.iter().any(|row| row.over_clips(metric).is_some());
    let (label, metric) = *metrics.iter().find(is_known)?;
    let mut curves: Vec<Curve> = Vec::new();
    for row in rows {
        let (Some(x), Some(y)) = (row.over_clips(&PSNR_A), row.over_clips(metric)) else {
            continue;
        };
        let point = Point { x: x.mean, y: y.mean, error: 0.0 };
        let name = format!("{}, {} PPP", row.method, row.ppp);
        match curves.iter_mut().find(|curve| curve.name == name) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve { name, points: vec![point] }),
        }
    }
    for curve in &mut curves {
        curve.points.sort_by(|a, b| a.x.total_cmp(&b.x));
    }
    Some(Plot {
        title: "Perception against distortion".to_owned(),
        caption: "Means over clips; a curve joins the numbers of diffusion steps of a method, usually fewer to the \
                  right. Lower looks more like the truth, further right is closer to it."
            .to_owned(),
        x: Axis::linear("PSNR after the best gain, dB"),
        y: Axis::linear(label),
        curves,
    })
}

fn clip(clip: &Pictures) -> Clip {
    let mut pictures = Vec::new();
    let mut add =
        |name: String, frame: &Frame| pictures.push(Picture { name, url: crop(frame, CROP) });
    add("counts".to_owned(), &clip.counts);
    for (method, frame) in &clip.restored {
        add(method.clone(), frame);
        if let Some(truth) = &clip.truth {
            add(format!("{method}: error"), &error(frame, truth));
        }
    }
    if let Some(truth) = &clip.truth {
        add("truth".to_owned(), truth);
    }
    // The last method against the truth; without one, the counts against it.
    let right = pictures.len() - 1;
    let left = if clip.truth.is_some() { right.saturating_sub(2) } else { 0 };
    let size = clip.counts.size;
    let shown = crop_size(size, CROP);
    Clip {
        name: clip.clip.clone(),
        // Four digits of an estimated level are plenty.
        ppp: (clip.ppp * 1e4).round() / 1e4,
        width: shown.width,
        height: shown.height,
        size: size.to_string(),
        cropped: shown != size,
        captions: clip.captions.clone(),
        pictures,
        left,
        right,
    }
}

/// Returns signed errors around middle gray.
fn error(image: &Frame, truth: &Frame) -> Frame {
    let pairs = image.data.iter().zip(&truth.data);
    let data = pairs.map(|(image, truth)| 0.5 + ERROR_GAIN * 0.5 * (image - truth)).collect();
    Frame { size: truth.size, data }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::eval::score::FrameScore;
    use qudi_core::Size;

    fn score(clip: &str, size: Size, how: &str) -> Score {
        let frame = FrameScore::of_values(&[(&PSNR_A, 25.0), (&SSIM, 0.9)]);
        Score {
            clip: clip.to_owned(),
            frames: vec![frame],
            chi_square: None,
            flicker: None,
            flow: None,
            added: None,
            range: None,
            seconds_per_frame: None,
            peak_mib: None,
            picture: Frame::filled(size, 0.5),
            how: how.to_owned(),
        }
    }

    fn pictures(clip: &str, size: Size) -> Pictures {
        let frame = Frame::filled(size, 0.4);
        Pictures::new(clip.to_owned(), 3.25, frame.clone(), Some(frame))
    }

    #[test]
    fn draws_clips_of_two_sizes_under_one_name() {
        let sizes = [Size { height: 24, width: 32 }, Size { height: 300, width: 40 }];
        let mut clips = sizes.map(|size| pictures("run", size));
        let scores = sizes.map(|size| score("run", size, ""));
        for (clip, score) in clips.iter_mut().zip(&scores) {
            clip.add("mle", score);
        }
        let rows = [Row { scores: scores.to_vec(), ..Row::new("mle".to_owned(), 3.25) }];
        let page = html(&rows, &[], &clips, "about").unwrap_or_else(|e| panic!("{e:?}"));
        assert!(page.contains("aspect-ratio:32/24") && page.contains("aspect-ratio:40/224"));
        assert!(page.contains("the middle 40 x 224 pixels"));
    }

    #[test]
    fn captions_say_how_pictures_were_made() {
        let size = Size { height: 24, width: 32 };
        let mut clip = pictures("<dog>", size);
        clip.add("qudi", &score("<dog>", size, " (diffusion in 4 steps) on cpu"));
        let page = html(&[], &[], &[clip], "about").unwrap_or_else(|e| panic!("{e:?}"));
        assert!(page.contains("qudi (diffusion in 4 steps) on cpu: PSNR 25.00 dB"), "{page}");
        assert!(page.contains("<b>&lt;dog&gt;</b>"), "names are no markup");
    }
}
