//! What tiles cost: a tiny network learns for a while on procedural scenes, then restores one burst whole and in
//! tiles.
//!
//!     cargo test --workspace --no-run && target/debug/examples/seams [STEPS] [SIDE] [REVERSE]
//!
//! learns for STEPS steps (0: the weights of the last time), and restores SIDE x SIDE pixels in REVERSE steps.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use qudi_model::checkpoint::{Description, load, save};
use qudi_model::config::NetworkConfig;
use qudi_model::measurement::{Planes, sensor_numbers};
use qudi_model::network::Measured;
use qudi_model::noise::Noise;
use qudi_model::objective::{Example, FirstPass, LossWeights, terms, training_time};
use qudi_model::restorer::{QudiRestorer, SampleOptions};
use qudi_model::tensor::to_tensor;
use qudi_sim::metrics::psnr;
use qudi_sim::output::Overwrite;
use qudi_sim::restore::{BurstView, Context, Restorer};
use qudi_sim::scene::{Procedural, ProceduralScene};
use qudi_sim::sensor::Sensor;
use qudi_sim::{Camera, Frame, Light, Size};
use std::path::Path;

/// A simulated burst of moving leaves: counts, truth, light.
fn burst(size: Size, frames: usize, seed: u64) -> (Vec<Vec<u16>>, Vec<Frame>, Context) {
    let kind = ProceduralScene::DeadLeaves;
    let scene = Procedural { kind, size, seed, speed: 1.5 }.scene();
    let truth: Vec<Frame> = (0..frames).map(|t| scene.render(t as f64)).collect();
    let sensor = Sensor::load("qudi-paper").unwrap();
    let exposure = truth.iter().map(Frame::mean).sum::<f64>() / frames as f64;
    let light = Light { ppp: 9.75, exposure };
    let mut camera = Camera::new(&sensor, size, light, seed).unwrap();
    let counts = (0..).zip(&truth).map(|(t, f)| camera.expose(t, &[f]).unwrap()).collect();
    let (ppp, gain, dark) = (light.ppp, camera.gain(), None);
    (counts, truth, Context { seed: 1, first_frame: 0, ppp, exposure, sensor, gain, dark })
}

/// Trains `tiny` for `steps` steps of one burst and writes its weights.
fn learn(steps: u64, path: &Path) {
    const FRAMES: usize = 7;
    let device = Device::flex().autodiff();
    let config = NetworkConfig::preset("tiny").unwrap();
    let mut network = config.init(1, &device);
    let mut optimizer = AdamConfig::new().with_epsilon(1e-8).init();
    let size = Size { height: 64, width: 64 };
    for step in 0..steps {
        let (counts, truth, context) = burst(size, FRAMES, step);
        let planes = Planes::of(BurstView { size, frames: &counts }, &context);
        let numbers = TensorData::new(sensor_numbers(&context).to_vec(), [1, 9]);
        let measured = Measured {
            y: to_tensor(planes.y, size, &device),
            u: to_tensor(planes.u, size, &device),
            sensor: Tensor::from_data(numbers, &device),
            frames: FRAMES,
        };
        let noise = Noise::new(step, 9);
        let noise = (0..FRAMES as u64).flat_map(|f| noise.frame(f, 0, size.pixels())).collect();
        let golden = |n: f64| (step as f64 * n).fract();
        let example = Example {
            measured: &measured,
            truth: to_tensor(truth.into_iter().flat_map(|f| f.data).collect(), size, &device),
            contexts: &[context],
            noise: to_tensor(noise, size, &device),
            times: &[training_time(golden(0.414_214), golden(0.618_034))],
        };
        let first_pass = if step.is_multiple_of(2) { FirstPass::No } else { FirstPass::Yes(step) };
        let terms = terms(&network, &example, first_pass, LossWeights::default()).unwrap();
        if step.is_multiple_of(100) {
            println!("step {step}: loss {:.5}", terms.prediction.clone().into_scalar::<f32>());
        }
        let grads = GradientsParams::from_grads(terms.total.backward(), &network);
        network = optimizer.step(2e-3 * (1.0 - step as f64 / (steps + 1) as f64), network, grads);
    }
    let description = Description {
        program: "seams".into(),
        preset: Some("tiny".into()),
        network: config,
        window: 11,
        sensors: vec!["qudi-paper".into()],
        ppp: [9.75, 9.75],
        data: vec!["scene:dead-leaves".into()],
        steps,
        commit: None,
        licence: "MIT OR Apache-2.0".into(),
    };
    save(&network, &description, path, Overwrite::Yes).unwrap();
}

fn main() {
    let mut arguments = std::env::args().skip(1).map(|a| a.parse::<usize>().unwrap());
    let steps = arguments.next().unwrap_or(600) as u64;
    let side = arguments.next().unwrap_or(512);
    let reverse = arguments.next().unwrap_or(10);
    let path = std::env::temp_dir().join("qudi-seams.safetensors");
    if steps > 0 {
        learn(steps, &path);
    }
    let device = Device::flex();
    let size = Size { height: side, width: side };
    let (counts, truth, context) = burst(size, 11, 1_000_000);
    let restore = |tile: usize| {
        let (network, description) = load(&path, &device).unwrap();
        let options = SampleOptions { tile, steps: reverse, ..SampleOptions::default() };
        let mut restorer =
            QudiRestorer::new(network, &description.network, 11, options, &device).unwrap();
        restorer.restore(BurstView { size, frames: &counts }, &context).unwrap().frames
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
    println!("weights: {}", path.display());
}
