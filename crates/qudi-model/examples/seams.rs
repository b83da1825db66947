//! What tiles cost: a network restores one burst whole and in tiles.
//!
//!     cargo run --release --example seams -- WEIGHTS [SIDE] [REVERSE]
//!
//! restores SIDE x SIDE pixels of moving leaves in REVERSE steps.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_core::metrics::psnr;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Frame, Light, Size};
use qudi_model::checkpoint::load;
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};
use qudi_sim::scene::{Procedural, ProceduralScene};
use std::path::PathBuf;

/// A simulated burst of moving leaves: counts, truth, light.
fn burst(size: Size, frames: usize) -> (Vec<Vec<u16>>, Vec<Frame>, Acquisition) {
    let (kind, seed) = (ProceduralScene::DeadLeaves, 1_000_000);
    let scene = Procedural { kind, size, seed, speed: 1.5 }.scene();
    let truth: Vec<Frame> = (0..frames).map(|t| scene.render(t as f64)).collect();
    let sensor = Sensor::load("qudi-paper").unwrap();
    let mean_level = truth.iter().map(Frame::mean).sum::<f64>() / frames as f64;
    let light = Light { ppp: 9.75, mean_level };
    let mut camera = Camera::new(&sensor, size, light, seed).unwrap();
    let counts = (0..).zip(&truth).map(|(t, f)| camera.expose(t, &[f]).unwrap()).collect();
    (counts, truth, Acquisition::new(sensor, light.ppp, mean_level).unwrap().with_seed(1))
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let weights = PathBuf::from(arguments.next().expect("a weight file"));
    let mut number = |otherwise| arguments.next().map_or(otherwise, |text| text.parse().unwrap());
    let (side, reverse) = (number(512), number(10));
    let device = Device::flex();
    let size = Size { height: side, width: side };
    let (counts, truth, acquisition) = burst(size, 11);
    let restore = |tile: usize| {
        let (network, description) = load(&weights, &device).unwrap();
        let options = SampleOptions { tile, steps: reverse, ..SampleOptions::default() };
        let (config, kind) = (description.network, description.kind.unwrap());
        let model = Model { network, config, kind, window: 11 };
        let mut restorer = QudiRestorer::new(model, options, &device).unwrap();
        restorer.restore(BurstView { size, frames: &counts }, &acquisition).unwrap().frames
    };
    let mean = |a: &[Frame], b: &[Frame]| {
        a.iter().zip(b).map(|(a, b)| psnr(a, b)).sum::<f64>() / a.len() as f64
    };
    let whole = restore(side);
    println!("whole: {:.2} dB against the truth", mean(&whole, &truth));
    for tile in [384, 320, 256, 192, 128] {
        let tiled = restore(tile);
        println!(
            "tiles of {tile}: {:.2} dB against the truth, {:.2} dB against the whole",
            mean(&tiled, &truth),
            mean(&tiled, &whole)
        );
    }
}
