//! The page of `qudi view`.

use super::frames::Frames;
use crate::error::Result;
use crate::report::html::render;
use crate::report::player::Scene;
use serde_json::json;

/// Renders the page, whose pictures are asked for when they are looked at.
pub(super) fn page(frames: &Frames<'_>, title: &str) -> Result<String> {
    let first = frames.first();
    let mut scene = Scene::new("Counts and restored frames", first.size(), first.pictures());
    scene.layers = frames.layers();
    scene.right = scene.layers.len() - 1;
    scene.notes = first.warnings().iter().map(|warning| format!("Warning: {warning}")).collect();
    scene.strip = first.strip();
    let context = json!({
        "title": title,
        "players": [scene.player()],
        "text": first.describe(),
    });
    render("view.html", context)
}
