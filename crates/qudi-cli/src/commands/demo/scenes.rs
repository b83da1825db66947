//! The built-in scenes: a colour photograph in motion behind a price tag, and a chart.

use crate::error::{CliError, Result};
use qudi_core::{Frame, Size};
use qudi_sim::scene::{
    Layer, Line, Motion, Paint, Procedural, ProceduralScene, Scene, Shape, StillMotion, still_scene,
};

/// The number of frames of the paper's window.
pub(super) const FRAMES: usize = 11;

pub(super) const SIZE: Size = Size { height: 256, width: 256 };

/// A photograph under the MIT licence, see `assets/melons.LICENSE`.
const PHOTOGRAPH: &[u8] = include_bytes!("../../../assets/melons.jpg");

/// A scene with its name.
pub(super) struct DemoScene {
    pub(super) name: &'static str,
    /// Description in a sentence.
    pub(super) about: &'static str,
    pub(super) planes: Planes,
}

/// A scene in gray, or in red, green and blue.
pub(super) enum Planes {
    Gray(Scene),
    Colour(Box<[Scene; 3]>),
}

/// Returns the scenes, the one that is shown first before the others.
pub(super) fn scenes() -> Result<[DemoScene; 2]> {
    Ok([
        DemoScene {
            name: "photograph",
            about: "A photograph that turns, pans and comes nearer, behind a price tag that passes in the opposite \
                    direction, seen through a Bayer filter (Grocery Store Dataset, Marcus Klasson, MIT licence). \
                    The built-in regression was not trained on this collection; the built-in diffusion and the \
                    network for colours were. Numbers are of luma.",
            planes: Planes::Colour(Box::new(photograph()?)),
        },
        DemoScene {
            name: "chart",
            about: "A turning and panning test chart behind two lines of text: hard edges, fine bars, strong contrast.",
            planes: Planes::Gray(chart()),
        },
    ])
}

/// Sets red, green and blue of the photograph in motion, and a tag before them.
fn photograph() -> Result<[Scene; 3]> {
    let image = image::load_from_memory(PHOTOGRAPH)
        .map_err(|e| CliError::new(e, "the built-in photograph", "report this as a bug"))?
        .into_rgb8();
    let size = Size { height: image.height() as usize, width: image.width() as usize };
    let plane = |k: usize| {
        let data = image.pixels().map(|pixel| f32::from(pixel.0[k]) / 255.0).collect();
        behind_tag(Frame { size, data })
    };
    Ok([plane(0), plane(1), plane(2)])
}

/// Sets an image in motion, and a tag before it.
fn behind_tag(image: Frame) -> Scene {
    let motion = StillMotion { pan: [2.4, -0.9], rotate: 0.4, zoom: 1.004, layers: 0 };
    let mut scene = still_scene(image, motion, SIZE, 0);
    let motion = Motion::pan([-6.0, 1.2]);
    let (centre, half) = ([196.0, 122.0], [47.0, 17.0]);
    scene.layers.push(Layer {
        motion,
        shape: Shape::Rectangle { centre, half },
        paint: Paint::Flat(0.93),
    });
    let text = Line {
        text: "19.90/KG".chars().collect(),
        origin: [centre[0] - 41.0, centre[1] - 6.0],
        dot: 1.75,
    };
    scene.layers.push(Layer { motion, shape: Shape::Text(text), paint: Paint::Flat(0.05) });
    scene
}

/// Makes a turning and panning chart behind two lines of text that pass it in opposite directions.
fn chart() -> Scene {
    let scene = |kind, speed| Procedural { kind, size: SIZE, seed: 4, speed }.scene();
    let mut chart = scene(ProceduralScene::Chart, 4.0);
    chart.layers.extend(scene(ProceduralScene::Text, 3.0).layers.into_iter().skip(1).step_by(2));
    chart
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tag_hides_and_uncovers_the_photograph_within_the_frame() {
        let [_, scene, _] = photograph().unwrap_or_else(|e| panic!("{e:?}"));
        let (first, last) = (scene.render(0.0), scene.render(10.0));
        // The tag falls by 12 pixels and moves to the left by 60.
        let bright = |frame: &Frame, row: usize, x: usize| frame.row(row)[x] > 0.9;
        assert!(bright(&first, 112, 160) && bright(&last, 124, 100) && !bright(&last, 124, 232));
        assert!(PHOTOGRAPH.len() <= 200_000);
    }
}
