//! The page of `qudi eval`: table, plots, and pictures that play.

use super::metrics::{CHI_SQUARE, GMSD, LPIPS_ALEX, LPIPS_VGG, Metric, PSNR_A, SSIM};
use super::score::{Row, Score};
use super::table::summary;
use crate::error::Result;
use crate::report::Table;
use crate::report::html::{TableView, render};
use crate::report::middle::{cut, cut_size};
use crate::report::player::{Kind, Layer, Player, QUALITY, Scene, counts_url, picture_url};
use crate::report::svg::{Axis, Curve, Drawing, Plot, Point};
use qudi_core::{Frame, Size};
use serde::Serialize;
use std::fmt::Write;

/// Bytes of all pictures of a page, about.
const PICTURES_BYTES: usize = 12_000_000;

/// Bytes of a picture, about.
const PICTURE_BYTES: usize = 14_000;

/// Frames of a loop at most.
const MAX_LOOP_FRAMES: usize = 33;

/// Frames of a loop at least: fewer do not show motion.
const MIN_LOOP_FRAMES: usize = 3;

/// The pictures of a clip at one light level, encoded.
pub(crate) struct Pictures {
    clip: String,
    ppp: f64,
    size: Size,
    /// Numbers of the frames that are shown.
    numbers: Vec<u64>,
    counts: Vec<String>,
    truth: Option<Vec<String>>,
    /// Restored frames by method.
    restored: Vec<(String, Vec<String>)>,
    captions: Vec<String>,
    /// Light and change of a capture over time.
    strip: Option<String>,
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
    players: Vec<Player>,
}

/// A further table.
#[derive(Serialize)]
struct Looks {
    title: &'static str,
    table: TableView,
}

impl Pictures {
    /// Creates the pictures of a clip from its counts, full scale for 1.
    pub(crate) fn new(clip: String, ppp: f64, numbers: Vec<u64>, counts: &[Frame]) -> Self {
        let size = counts.first().map_or(Size { height: 1, width: 1 }, |counts| counts.size);
        let counts = counts.iter().map(|counts| counts_url(&cut(counts), QUALITY)).collect();
        let (truth, restored, captions, strip) = (None, Vec::new(), Vec::new(), None);
        Self { clip, ppp, size, numbers, counts, truth, restored, captions, strip }
    }

    /// Adds the truth of the shown frames.
    pub(crate) fn with_truth(self, truth: &[Frame]) -> Self {
        let truth = truth.iter().map(|truth| picture_url(&cut(truth), QUALITY)).collect();
        Self { truth: Some(truth), ..self }
    }

    /// Adds light and change of the capture over time.
    pub(crate) fn with_strip(self, strip: Option<String>) -> Self {
        Self { strip, ..self }
    }

    /// Adds the restored frames of a method, and takes them out of its score.
    pub(crate) fn add(&mut self, method: &str, score: &mut Score) {
        let middle = score.frames.get(score.frames.len() / 2);
        let value = |metric| middle.and_then(|frame| frame.get(metric));
        let mut caption = format!("{method}{}", score.how);
        if let (Some(psnr_a), Some(ssim)) = (value(&PSNR_A), value(&SSIM)) {
            let _ = write!(caption, ": PSNR {psnr_a:.2} dB after the best gain, SSIM {ssim:.3}");
        } else if let Some(chi_square) = value(&CHI_SQUARE) {
            let _ = write!(caption, ": chi-square {chi_square:.3}");
        }
        self.captions.push(caption);
        let frames = std::mem::take(&mut score.pictures);
        let urls = frames.iter().map(|frame| picture_url(frame, QUALITY)).collect();
        self.restored.push((method.to_owned(), urls));
    }

    /// Returns the pictures as the template plays them.
    fn player(&self) -> Player {
        // Four digits of an estimated level are plenty.
        let ppp = (self.ppp * 1e4).round() / 1e4;
        let (shown, frames) = (cut_size(self.size), self.numbers.len() as u64);
        let title = format!("{}, {ppp} photons per pixel and frame", self.clip);
        let mut scene = Scene::new(title, shown, frames);
        if shown != self.size {
            scene.caption = vec![format!("The middle {shown} pixels of {}.", self.size)];
        }
        scene.numbers = Some(self.numbers.clone());
        scene.layers = vec![Layer::new("counts", Kind::Counts, self.counts.clone())];
        for (method, frames) in &self.restored {
            scene.layers.push(Layer::new(method, Kind::Restored, frames.clone()));
        }
        // The last method against the truth; without one, the counts against it.
        scene.right = scene.layers.len() - 1;
        if let Some(truth) = &self.truth {
            scene.layers.push(Layer::new("truth", Kind::Truth, truth.clone()));
            (scene.left, scene.right) = (scene.right, scene.right + 1);
        }
        scene.notes.clone_from(&self.captions);
        scene.strip.clone_from(&self.strip);
        scene.player()
    }
}

/// Returns how many frames a loop of each of `pictures` pictures has, so that the page stays small.
pub(crate) fn loop_frames(pictures: usize) -> usize {
    let fitting = PICTURES_BYTES / (PICTURE_BYTES * pictures.max(1));
    if fitting < MIN_LOOP_FRAMES { 1 } else { fitting.min(MAX_LOOP_FRAMES) }
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
            players: pictures.iter().map(Pictures::player).collect(),
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
            pictures: vec![cut(&Frame::filled(size, 0.5))],
            how: how.to_owned(),
        }
    }

    fn pictures(clip: &str, size: Size) -> Pictures {
        let frames = [Frame::filled(size, 0.4)];
        Pictures::new(clip.to_owned(), 3.25, vec![0], &frames).with_truth(&frames)
    }

    #[test]
    fn draws_clips_of_two_sizes_under_one_name() {
        let sizes = [Size { height: 24, width: 32 }, Size { height: 300, width: 40 }];
        let mut clips = sizes.map(|size| pictures("run", size));
        let mut scores = sizes.map(|size| score("run", size, ""));
        for (clip, score) in clips.iter_mut().zip(&mut scores) {
            clip.add("mle", score);
        }
        let rows = [Row { scores: scores.to_vec(), ..Row::new("mle".to_owned(), 3.25) }];
        let page = html(&rows, &[], &clips, "about").unwrap_or_else(|e| panic!("{e:?}"));
        assert!(page.contains("aspect-ratio:32/24") && page.contains("aspect-ratio:40/224"));
        assert!(page.contains("The middle 224 x 40 pixels of 300 x 40"));
    }

    #[test]
    fn captions_say_how_pictures_were_made() {
        let size = Size { height: 24, width: 32 };
        let mut clip = pictures("<dog>", size);
        clip.add("qudi", &mut score("<dog>", size, " (diffusion in 4 steps) on cpu"));
        let page = html(&[], &[], &[clip], "about").unwrap_or_else(|e| panic!("{e:?}"));
        assert!(page.contains("qudi (diffusion in 4 steps) on cpu: PSNR 25.00 dB"), "{page}");
        assert!(page.contains("&lt;dog&gt;, 3.25") && !page.contains("<dog>"), "no markup");
    }

    #[test]
    fn loops_are_short_where_there_are_many_pictures() {
        assert_eq!(loop_frames(4), MAX_LOOP_FRAMES);
        assert_eq!(loop_frames(231), 3);
        assert_eq!(loop_frames(1000), 1);
    }
}
