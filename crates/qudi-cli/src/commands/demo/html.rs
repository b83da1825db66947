//! The page of `qudi demo`: every scene with all its frames, the figures, and what they mean.

use super::restored::{CENTRE, RestoredScene};
use super::scenes::{FRAMES, SIZE};
use crate::error::Result;
use crate::report::Column;
use crate::report::html::{TableView, render};
use crate::report::player::{
    Kind, Layer, MAX_UNCERTAINTY, Player, Scene, colour_url, counts_frame, counts_url, map_url,
    picture_url,
};
use qudi_core::Frame;
use serde::Serialize;

/// Largest size of the page in bytes.
const MAX_BYTES: usize = 3_000_000;

/// JPEG qualities: the highest one whose page is small enough is taken.
const QUALITIES: [u8; 6] = [94, 92, 90, 87, 83, 78];

/// The method whose frames are all the same.
const AVERAGE: &str = "average";

/// The context of the template.
#[derive(Serialize)]
struct Page<'a> {
    title: &'a str,
    light: String,
    frames: usize,
    players: Vec<Player>,
    made: Vec<String>,
    settings: &'a str,
    about: &'a str,
}

/// Renders the page.
pub(super) fn html(
    scenes: &[RestoredScene],
    ppp: f64,
    settings: &str,
    about: &str,
) -> Result<String> {
    let mut smallest = String::new();
    for quality in QUALITIES {
        smallest = page(scenes, quality, ppp, settings, about)?;
        if smallest.len() <= MAX_BYTES {
            break;
        }
    }
    Ok(smallest)
}

fn page(
    scenes: &[RestoredScene],
    quality: u8,
    ppp: f64,
    settings: &str,
    about: &str,
) -> Result<String> {
    let first = scenes.first();
    let how = first.into_iter().flat_map(|scene| &scene.methods);
    render(
        "demo.html",
        Page {
            title: "Video from single photons",
            light: format!("{ppp} photons per pixel and frame on average"),
            frames: FRAMES,
            players: scenes.iter().map(|scene| player(scene, quality)).collect(),
            made: how.map(|method| format!("{}: {}", method.name, method.how)).collect(),
            settings,
            about,
        },
    )
}

fn player(restored: &RestoredScene, quality: u8) -> Player {
    let exposed = &restored.exposed;
    let sensor = &exposed.acquisition.sensor;
    let url = |planes: [&Frame; 3]| {
        if exposed.is_coloured() {
            colour_url(&planes.map(Frame::clone), quality)
        } else {
            picture_url(planes[0], quality)
        }
    };
    let counts = exposed
        .counts
        .iter()
        .map(|counts| counts_url(&counts_frame(SIZE, counts, sensor.max_count()), quality));
    let mut scene = Scene::new(capitalized(exposed.name), SIZE, FRAMES as u64);
    scene.caption = vec![exposed.about.to_owned()];
    let bits = format!("{} bit", sensor.output_bits());
    scene.layers.push(Layer::new("counts", Kind::Counts, counts.collect()).with_note(bits));
    for method in &restored.methods {
        let note = format!("{:.2} dB", method.psnr_a[CENTRE]);
        // The mean is the same for all frames.
        let shown = if method.name == AVERAGE { CENTRE..CENTRE + 1 } else { 0..FRAMES };
        let layer =
            Layer::new(method.name, Kind::Restored, shown.map(|t| url(method.planes(t))).collect());
        scene.layers.push(layer.with_note(note));
    }
    scene.right = scene.layers.len() - 1;
    let truth =
        Layer::new("truth", Kind::Truth, (0..FRAMES).map(|t| url(exposed.truth(t))).collect());
    scene.layers.push(truth.with_note("without noise"));
    let sigmas = restored.uncertainty.frames.iter();
    let sigmas = sigmas.map(|sigma| map_url(sigma, MAX_UNCERTAINTY)).collect();
    let uncertainty = Layer::new("uncertainty", Kind::Map, sigmas);
    let last = restored.methods.last().map_or("", |method| method.name);
    scene
        .layers
        .push(uncertainty.into_map(MAX_UNCERTAINTY, restored.uncertainty.meaning).with_note(last));
    // The scene's name is above the pictures.
    let mut table = restored.table();
    table.columns[0] = Column::new("method", "centre frame");
    scene.table = Some(TableView::from(&table));
    scene.notes = vec![
        "psnr-a is the PSNR after the best gain, since counts do not tell the brightness; pictures and errors are \
         after it, too. ± is the 95 % confidence of the mean over the frames of this scene."
            .to_owned(),
        "Errors are computed from the compressed pictures of this page; the numbers are not.".to_owned(),
    ];
    scene.player()
}

fn capitalized(name: &str) -> String {
    let mut characters = name.chars();
    characters
        .next()
        .map_or(String::new(), |first| first.to_uppercase().chain(characters).collect())
}
