//! The page of a restoration: counts, restored frames and uncertainty that play, the misfit, the settings.

use super::args::Tonemap;
use super::output::toned;
use crate::colour::{Rendering, encoded};
use crate::error::Result;
use crate::report::counted;
use crate::report::html::render;
use crate::report::player::{
    Kind, Layer, MAX_FRAMES, MAX_UNCERTAINTY, QUALITY, Scene, colour_url, counts_frame, counts_url,
    frame_distance, map_url, picture_url,
};
use qudi_core::{Frame, Size};
use serde_json::{Value, json};

/// Chi-square at the end of its key.
const MAX_CHI_SQUARE: f32 = 2.0;

/// The pictures of a page, encoded as they come.
pub(super) struct RestoredPage {
    size: Size,
    max_count: u16,
    tonemap: Tonemap,
    /// Rendering of colours, if there are any.
    rendering: Option<Rendering>,
    /// Distance between shown frames.
    distance: u64,
    /// Frames that came so far.
    frames: u64,
    numbers: Vec<u64>,
    counts: Vec<String>,
    restored: Vec<String>,
    sigmas: Vec<String>,
}

/// What a page says about its pictures.
pub(super) struct About<'a> {
    pub(super) capture: String,
    pub(super) method: &'a str,
    pub(super) text: &'a str,
    pub(super) warnings: &'a [String],
    pub(super) settings: &'a Value,
    /// Chi-square of every pixel, where it is measured.
    pub(super) misfit: Option<Frame>,
    /// Light and change of the capture over time.
    pub(super) strip: Option<String>,
}

impl RestoredPage {
    /// Creates the page of `pictures` frames, or of the first ones of a pipe.
    pub(super) fn new(
        size: Size,
        max_count: u16,
        tonemap: Tonemap,
        rendering: Option<Rendering>,
        pictures: Option<u64>,
    ) -> Self {
        let distance = pictures.map_or(1, |pictures| frame_distance(size, pictures));
        let [counts, restored, sigmas] = [const { Vec::new() }; 3];
        let (frames, numbers) = (0, Vec::new());
        Self {
            size,
            max_count,
            tonemap,
            rendering,
            distance,
            frames,
            numbers,
            counts,
            restored,
            sigmas,
        }
    }

    /// Takes the next frame with its counts.
    pub(super) fn add(&mut self, restored: &Frame, counts: &[u16]) {
        if self.shows(self.frames) {
            self.restored.push(picture_url(&toned(self.tonemap, restored), QUALITY));
        }
        self.add_counts(counts);
    }

    /// Takes the colours of the next frame with its counts.
    pub(super) fn add_colour(&mut self, restored: &[Frame; 3], counts: &[u16]) {
        if self.shows(self.frames) {
            let rendered = self.rendering.as_ref().map(|rendering| rendering.rendered(restored));
            let shown = encoded(rendered.as_ref().unwrap_or(restored));
            self.restored.push(colour_url(&shown, QUALITY));
        }
        self.add_counts(counts);
    }

    fn add_counts(&mut self, counts: &[u16]) {
        if self.shows(self.frames) {
            self.numbers.push(self.frames);
            let counts = counts_frame(self.size, counts, self.max_count);
            self.counts.push(counts_url(&counts, QUALITY));
        }
        self.frames += 1;
    }

    /// Takes the uncertainty of the frame that came last.
    pub(super) fn add_uncertainty(&mut self, sigma: &Frame) {
        if self.shows(self.frames.saturating_sub(1)) {
            self.sigmas.push(map_url(sigma, MAX_UNCERTAINTY));
        }
    }

    fn shows(&self, frame: u64) -> bool {
        frame.is_multiple_of(self.distance) && frame / self.distance < MAX_FRAMES
    }

    /// Renders the page.
    pub(super) fn html(self, about: About<'_>) -> Result<String> {
        let (shown, frames) = (self.numbers.len(), self.frames);
        let mut scene = Scene::new("Counts and restored frames", self.size, shown as u64);
        if shown as u64 != frames {
            let distance = self.distance;
            scene.caption = vec![format!("{shown} of {frames} frames, {distance} apart.")];
        }
        scene.strip = about.strip;
        scene.numbers = Some(self.numbers);
        scene.layers = vec![
            Layer::new("counts", Kind::Counts, self.counts),
            Layer::new(about.method, Kind::Restored, self.restored),
        ];
        scene.right = 1;
        scene.total = Some(frames);
        // A run that went on has predicted uncertainty for the rest alone.
        if self.sigmas.len() == shown && shown > 0 {
            let layer = Layer::new("uncertainty", Kind::Map, self.sigmas);
            let meaning =
                "the standard deviation of its errors that the method predicts, in units of white";
            scene.layers.push(layer.into_map(MAX_UNCERTAINTY, meaning));
        }
        if let Some(misfit) = about.misfit {
            let misfit = map_url(&misfit, MAX_CHI_SQUARE);
            let meaning = "chi-square of the counts of every pixel given the result: 1 where it explains them";
            let misfit = Layer::new("misfit", Kind::Map, vec![misfit]);
            scene.layers.push(misfit.into_map(MAX_CHI_SQUARE, meaning));
        }
        let settings = serde_json::to_string_pretty(about.settings).unwrap_or_default();
        let context = json!({
            "title": about.capture,
            "lead": format!("{} of {} restored by {}.", counted(frames, "frame"), self.size, about.method),
            "warnings": about.warnings,
            "players": [scene.player()],
            "text": about.text,
            "settings": settings,
        });
        render("restore.html", context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size { height: 8, width: 10 };

    fn page(pictures: Option<u64>, added: u64) -> RestoredPage {
        let mut page = RestoredPage::new(SIZE, 7, Tonemap::None, None, pictures);
        for _ in 0..added {
            page.add(&Frame::filled(SIZE, 0.5), &vec![3; SIZE.pixels()]);
            page.add_uncertainty(&Frame::filled(SIZE, 0.1));
        }
        page
    }

    #[test]
    fn names_with_markup_are_text() {
        let about = About {
            capture: "<img src=x onerror=alert(1)>.npy".to_owned(),
            method: "mle",
            text: "</pre><script>alert(2)</script>",
            warnings: &["<b>".to_owned()],
            settings: &json!({"capture": "</script><script>alert(3)</script>"}),
            misfit: Some(Frame::filled(SIZE, 1.0)),
            strip: None,
        };
        let page = page(Some(3), 3).html(about).unwrap_or_else(|e| panic!("{e:?}"));
        assert_eq!(page.matches("<script").count(), 2, "ours: the data and the player");
        assert!(
            page.contains("&lt;img src=x") && !page.contains("<img") && !page.contains("<b>&lt;b")
        );
    }

    #[test]
    fn long_captures_and_pipes_show_some_frames() {
        assert_eq!(page(Some(150), 150).numbers.len(), 50);
        assert_eq!(page(None, 150).numbers.len(), 60);
        let page = page(Some(11), 11);
        assert_eq!((page.numbers.len(), page.sigmas.len()), (11, 11));
    }
}
