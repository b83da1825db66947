//! Both networks as methods: sizes, seeds, samples, tiles, backends, and what it refuses.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::Sensor;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::sampler::Sampler;
use qudi_model::diffusion::{Diffusion, DiffusionConfig, DiffusionRestorer, SampleOptions};
use qudi_model::regression::{FirstFrames, RegressionConfig, RegressionRestorer};
use qudi_model::restorer::Model;
use qudi_model::window::{Window, WindowConfig};
use qudi_model::{ComputePrecision, init_parameters};
use std::sync::Arc;

fn acquisition(seed: u64, first_frame: u64) -> Acquisition {
    let sensor = Sensor::load("qudi-paper").unwrap();
    let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap();
    acquisition.with_seed(seed).with_first_frame(first_frame)
}

fn config() -> DiffusionConfig {
    let text = include_str!("../../../tests/golden/tiny.toml");
    let NetworkConfig::Diffusion(config) = NetworkConfig::parse(text, "tiny").unwrap() else {
        panic!("tiny is a diffusion")
    };
    config
}

/// Values that are not zero, so that every layer matters.
fn values(name: &str, shape: &[usize]) -> Vec<f32> {
    let count: usize = shape.iter().product();
    let seed = name.bytes().fold(7u32, |h, b| h.wrapping_mul(31).wrapping_add(b.into()));
    let bound = if shape.len() > 1 { (1.5 / (count / shape[0]) as f32).sqrt() } else { 0.1 };
    let norm = shape.len() == 1 && name.ends_with("weight");
    (0..count as u32)
        .map(|i| {
            let z = seed.wrapping_add(i).wrapping_mul(0x9E37_79B9);
            let z = (z ^ (z >> 15)).wrapping_mul(0x85EB_CA6B);
            let u = (z >> 8) as f32 / (1 << 23) as f32 - 1.0;
            if norm { 1.0 + 0.1 * u } else { bound * u }
        })
        .collect()
}

/// Returns a tiny diffusion.
fn restorer(options: SampleOptions, device: &Device) -> DiffusionRestorer<Diffusion> {
    let network = init_parameters(config().init(2, device), values);
    let model = Model { network, config: config(), window: 11, passes: 1 };
    DiffusionRestorer::new(model, options, device).unwrap()
}

/// Returns the sizes of a tiny regression.
fn regression_config() -> RegressionConfig {
    let text = include_str!("../../../tests/golden/regression.toml");
    let NetworkConfig::Regression(config) = NetworkConfig::parse(text, "regression").unwrap()
    else {
        panic!("not a regression")
    };
    config
}

/// Returns a tiny regression.
fn regression(tile: usize) -> qudi_core::Result<RegressionRestorer> {
    let config = regression_config();
    let network = init_parameters(config.init(2, &Device::flex()), values);
    let model = Model { network, config, window: 11, passes: 1 };
    RegressionRestorer::new(model, None, tile, ComputePrecision::F32, &Device::flex())
}

fn counts(size: Size, frames: usize) -> Vec<Vec<u16>> {
    (0..frames)
        .map(|t| {
            (0..size.pixels()).map(|i| ((i * 7 + t * 13 + i / size.width) % 8) as u16).collect()
        })
        .collect()
}

fn restore(
    options: SampleOptions,
    acquisition: &Acquisition,
    size: Size,
    frames: usize,
) -> Restored {
    let counts = counts(size, frames);
    let burst = BurstView { size, frames: &counts };
    restorer(options, &Device::flex()).restore(burst, acquisition).unwrap()
}

const SIZE: Size = Size { height: 21, width: 38 };

fn quick() -> SampleOptions {
    SampleOptions { steps: 2, ..SampleOptions::default() }
}

#[test]
fn restores_any_size_and_length() {
    for (height, width, frames) in [(21, 38, 4), (8, 8, 3), (1, 50, 5), (40, 33, 12)] {
        let size = Size { height, width };
        let restored = restore(quick(), &acquisition(1, 0), size, frames);
        assert_eq!(restored.frames.len(), frames);
        assert!(restored.std.is_none());
        for frame in restored.frames {
            assert_eq!(frame.size, size);
            assert!(frame.data.iter().all(|v| (0.0..=1.0).contains(v)), "{size}");
        }
    }
}

#[test]
fn regression_restores_frames_and_their_uncertainty() {
    for (height, width, frames) in [(21, 38, 4), (24, 150, 3)] {
        let (size, counts) = (Size { height, width }, counts(Size { height, width }, frames));
        let burst = BurstView { size, frames: &counts };
        let restored = regression(128).unwrap().restore(burst, &acquisition(1, 0)).unwrap();
        let std = restored.std.unwrap();
        assert_eq!((restored.frames.len(), std.len()), (frames, frames));
        for (frame, std) in restored.frames.iter().zip(&std) {
            assert_eq!((frame.size, std.size), (size, size));
            assert!(frame.data.iter().all(|v| (0.0..=1.0).contains(v)), "{size}");
            assert!(std.data.iter().all(|v| *v > 0.0 && *v <= 0.5), "{size}");
        }
    }
    let error = regression(64).unwrap_err();
    assert!(error.to_string().contains("64 pixels") && error.help().is_some(), "{error}");
}

/// Returns a window network with random weights.
fn window() -> Arc<DiffusionRestorer<Window>> {
    let config = WindowConfig {
        widths: [32; 3],
        flow: [32; 3],
        state: 32,
        cell_blocks: 1,
        linear_entries: true,
    };
    let network = config.init(1, &Device::flex());
    let model = Model { network, config, window: 11, passes: 1 };
    Arc::new(DiffusionRestorer::new(model, SampleOptions::default(), &Device::flex()).unwrap())
}

/// Returns a regression that corrects a window network's frames: with initial weights, or others.
fn correction(
    of: Option<Arc<DiffusionRestorer<Window>>>,
    is_initial: bool,
) -> qudi_core::Result<RegressionRestorer> {
    let config = RegressionConfig { first: FirstFrames::Diffusion, ..regression_config() };
    let mut network = config.init(2, &Device::flex());
    if !is_initial {
        network = init_parameters(network, values);
    }
    let model = Model { network, config, window: 11, passes: 1 };
    RegressionRestorer::new(model, of, 512, ComputePrecision::F32, &Device::flex())
}

/// Initial weights correct nothing: but for the temporal filter, the frames are the window network's.
#[test]
fn frames_of_a_diffusion_are_corrected() {
    let size = Size { height: 40, width: 56 };
    let counts = counts(size, 4);
    let burst = BurstView { size, frames: &counts };
    let restored = |is_initial| {
        let mut restorer = correction(Some(window()), is_initial).unwrap();
        assert_eq!(restorer.name(), "qudi-diffusion");
        restorer.restore(burst, &acquisition(1, 0)).unwrap()
    };
    let mut diffusion = Arc::into_inner(window()).unwrap();
    let first = diffusion.restore(burst, &acquisition(1, 0)).unwrap();
    let distance = |one: &Restored, other: &Restored| {
        let pixels = |all: &Restored| -> Vec<f32> {
            all.frames.iter().flat_map(|frame| frame.data.clone()).collect()
        };
        let (one, other) = (pixels(one), pixels(other));
        let squares: f32 = one.iter().zip(&other).map(|(a, b)| (a - b).powi(2)).sum();
        (squares / one.len() as f32).sqrt()
    };
    let (initial, corrected) = (restored(true), restored(false));
    let [filtered, moved] = [&initial, &corrected].map(|frames| distance(frames, &first));
    let mut other = regression(128).unwrap();
    let other = distance(&other.restore(burst, &acquisition(1, 0)).unwrap(), &first);
    assert!(filtered < 0.3 * other && filtered < moved, "{filtered}, {moved}, {other}");
    assert!(corrected.std.is_some_and(|std| std.len() == 4));
    let error = correction(None, true).unwrap_err().to_string();
    assert!(error.contains("corrects the frames of a diffusion"), "{error}");
    let config = regression_config();
    let network = config.init(2, &Device::flex());
    let model = Model { network, config, window: 11, passes: 1 };
    let both =
        RegressionRestorer::new(model, Some(window()), 512, ComputePrecision::F32, &Device::flex());
    assert!(both.unwrap_err().to_string().contains("restores its own"));
}

#[test]
fn result_depends_on_the_seed_alone() {
    for sampler in [Sampler::Ddim, Sampler::Ancestral] {
        let options = SampleOptions { sampler, ..quick() };
        let frames = |seed| restore(options, &acquisition(seed, 40), SIZE, 3).frames;
        assert_eq!(frames(1), frames(1));
        assert_ne!(frames(1), frames(2));
    }
}

#[test]
fn samples_give_a_mean_and_an_uncertainty() {
    let options = SampleOptions { samples: 3, ..quick() };
    let three = restore(options, &acquisition(1, 0), SIZE, 3);
    let std = three.std.unwrap();
    assert!(std.iter().all(|frame| frame.data.iter().all(|v| v.is_finite() && *v >= 0.0)));
    assert!(std.iter().any(|frame| frame.data.iter().any(|&v| v > 0.0)));
    // The first of the samples is what one sample gives.
    let one = restore(quick(), &acquisition(1, 0), SIZE, 3);
    assert_ne!(one.frames, three.frames);
}

#[test]
fn ndarray_and_flex_restore_alike() {
    #[allow(deprecated)] // asked for by name
    let ndarray = Device::ndarray();
    let size = Size { height: 16, width: 16 };
    let counts = counts(size, 3);
    let burst = BurstView { size, frames: &counts };
    // One step: later ones draw counts from estimates, and a count may flip on rounding.
    let options = SampleOptions { steps: 1, ..quick() };
    let [a, b] = [Device::flex(), ndarray.clone()].map(|device| {
        restorer(options, &device).restore(burst, &acquisition(1, 0)).unwrap().frames
    });
    for (a, b) in a.iter().zip(&b) {
        for (a, b) in a.data.iter().zip(&b.data) {
            assert!((a - b).abs() < 1e-4, "{a} and {b}");
        }
    }
    restorer(quick(), &ndarray).restore(burst, &acquisition(1, 0)).unwrap();
}

#[test]
fn tiled_result_resembles_the_whole() {
    let size = Size { height: 48, width: 80 };
    let options = SampleOptions { steps: 2, tile: 32, ..SampleOptions::default() };
    let tiled = restore(options, &acquisition(1, 0), size, 3);
    let whole = restore(quick(), &acquisition(1, 0), size, 3);
    // Random weights let every pixel see far: the two are alike, not equal.
    for (tiled, whole) in tiled.frames.iter().zip(&whole.frames) {
        assert_eq!(tiled.size, whole.size);
        let pairs = tiled.data.iter().zip(&whole.data);
        let difference = pairs.map(|(a, b)| (a - b).powi(2)).sum::<f32>() / size.pixels() as f32;
        let mean = whole.data.iter().sum::<f32>() / size.pixels() as f32;
        let variance =
            whole.data.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / size.pixels() as f32;
        assert!(difference < 0.5 * variance, "{difference} of {variance}");
    }
}

#[test]
fn rejects_short_bursts_and_impossible_options() {
    let device = Device::flex();
    let size = Size { height: 16, width: 16 };
    let two = counts(size, 2);
    let error = restorer(quick(), &device)
        .restore(BurstView { size, frames: &two }, &acquisition(1, 0))
        .unwrap_err();
    assert!(error.to_string().contains("2 frames") && error.help().is_some(), "{error}");
    for options in [
        SampleOptions { steps: 0, ..quick() },
        SampleOptions { steps: 1001, ..quick() },
        SampleOptions { samples: 0, ..quick() },
        SampleOptions { passes: 0, ..quick() },
        SampleOptions { passes: 2, ..quick() },
        SampleOptions { tile: 8, ..quick() },
    ] {
        let model =
            Model { network: config().init(1, &device), config: config(), window: 11, passes: 1 };
        let error = DiffusionRestorer::new(model, options, &device).unwrap_err();
        let field = error.place().unwrap();
        assert!(
            ["steps", "samples", "passes", "tile"].contains(&field.as_str())
                && error.help().is_some(),
            "{error}"
        );
    }
}
