//! The picture of `qudi demo`: for every scene a row of frames, and a row of errors below it.

use super::restored::{CENTRE, RestoredScene, rms};
use super::scenes::{FRAMES, SIZE};
use crate::report::grid::Grid;
use crate::report::player::counts_frame;
use qudi_core::Frame;

/// The factor by which errors and uncertainty are shown brighter than images.
const ERROR_GAIN: f32 = 4.0;

/// Composes the picture of all scenes.
pub(super) fn picture(scenes: &[RestoredScene], ppp: f64) -> Grid {
    let columns = scenes.iter().map(|scene| scene.methods.len()).max().unwrap_or(0) + 2;
    let mut picture = Grid::new(SIZE, 2 * scenes.len(), columns, 2);
    for (n, scene) in scenes.iter().enumerate() {
        place(&mut picture, 2 * n, scene, ppp);
    }
    picture
}

/// Places a scene in two rows: frames, and errors below them.
fn place(picture: &mut Grid, row: usize, scene: &RestoredScene, ppp: f64) {
    let sensor = &scene.exposed.acquisition.sensor;
    let counts =
        |frame: usize| counts_frame(SIZE, &scene.exposed.counts[frame], sensor.max_count());
    let bits = format!("{} BIT", sensor.output_bits());
    picture.place(row, 0, &["COUNTS", &bits], [&counts(CENTRE); 3]);
    picture.place(row + 1, 0, &["COUNTS", &format!("LAST OF {FRAMES}")], [&counts(FRAMES - 1); 3]);
    for (column, method) in (1..).zip(&scene.methods) {
        let psnr = format!("{:.1} DB", method.psnr_a[CENTRE]);
        picture.place(row, column, &[method.label, &psnr], method.planes(CENTRE));
        let error = scene.error(method);
        let size = format!("RMS {:.3}", rms(&error));
        picture.place(row + 1, column, &["ERROR X4", &size], [&brighter(&error); 3]);
    }
    let last = scene.methods.len() + 1;
    let light = format!("{ppp} PPP");
    picture.place(row, last, &["TRUTH", &light], scene.exposed.truth(CENTRE));
    let uncertainty = scene.uncertainty.centre();
    let size = format!("RMS {:.3}", rms(uncertainty));
    picture.place(row + 1, last, &["UNCERTAINTY X4", &size], [&brighter(uncertainty); 3]);
}

fn brighter(frame: &Frame) -> Frame {
    Frame { size: frame.size, data: frame.data.iter().map(|v| v * ERROR_GAIN).collect() }
}
