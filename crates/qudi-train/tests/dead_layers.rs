//! Layers whose units are off for every input are told.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_model::diffusion::Diffusion;
use qudi_model::window::Window;
use qudi_model::{init_parameters, parameter_shapes};
use qudi_train::{Event, Files, From, Learner, Origin, Recipe, Run, parameters};
use std::collections::HashMap;
use std::ops::ControlFlow;

/// Returns a small window network whose levels can go dead, and that trains for fourteen steps, its state
/// written after every second one.
fn recipe() -> Recipe {
    let changes = [
        ("network.widths", "[16, 16, 16]"),
        ("network.flow", "[8, 8, 8]"),
        ("network.state", "16"),
        ("network.linear_entries", "false"),
        ("data.crop", "32"),
        ("data.frames", "3"),
        ("train.steps", "14"),
        ("train.checkpoint", "2"),
        ("train.warmup", "2"),
        ("validation.frames", "3"),
        ("validation.crop", "32"),
        ("validation.every", "14"),
    ];
    let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
    Recipe::load("tiny", &changes).unwrap()
}

/// Trains the network, in which a layer's bias may be replaced, and returns what is told of dead layers.
fn told(bias: Option<(&str, f32)>) -> Vec<Vec<String>> {
    let recipe = recipe();
    let network = Window::init(&recipe, &Device::flex()).unwrap();
    let names = parameter_shapes(&network).into_iter().map(|(name, _)| name);
    let values = parameters(&network).into_iter().map(|v| v.into_data().try_into_vec().unwrap());
    let mut values: HashMap<String, Vec<f32>> = names.zip(values).collect();
    if let Some((name, value)) = bias {
        values.get_mut(name).unwrap().fill(value);
    }
    told_in(&recipe, init_parameters(network, |name, _| values[name].clone()))
}

/// Trains a network by a recipe, and returns what is told of dead layers.
fn told_in<L: Learner>(recipe: &Recipe, network: L) -> Vec<Vec<String>> {
    let folder = tempfile::tempdir().unwrap();
    let start = From::Start(Some(Box::new(network)));
    let devices = [Device::flex()];
    let mut run = Run::open(
        folder.path(),
        recipe,
        start,
        Files::default(),
        &devices,
        None,
        Origin::default(),
    )
    .unwrap();
    let mut told = Vec::new();
    run.learn(1, &mut |event| {
        if let Event::Dead(layers) = event {
            told.push(layers.to_vec());
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    told
}

/// A level of the U-Net whose first units are off: neither it nor what only it sees learns. It is told once.
#[test]
fn a_dead_level_is_told_with_what_lies_behind_it() {
    let told = told(Some(("unet.hourglass.decoder.1.entry.bias", -1e3)));
    let [layers] = told.as_slice() else { panic!("told {} times", told.len()) };
    let level = |name: &&String| name.starts_with("unet.hourglass.");
    assert_eq!(layers.iter().filter(level).count(), layers.len(), "{layers:?}");
    for dead in ["decoder.1.entry", "up.1", "encoder.1.entry", "encoder.2.blocks.0.second"] {
        assert!(layers.contains(&format!("unet.hourglass.{dead}")), "{dead} in {layers:?}");
    }
    for alive in ["encoder.0.entry", "decoder.0.entry"] {
        assert!(!layers.contains(&format!("unet.hourglass.{alive}")), "{alive} in {layers:?}");
    }
}

#[test]
fn nothing_is_told_of_layers_that_learn() {
    assert_eq!(told(None), Vec::<Vec<String>>::new());
}

/// Nothing is told of layers whose input the recipe leaves at zero, nor in the first steps, when layers that
/// begin at zero pass no gradient.
#[test]
fn nothing_is_told_of_layers_without_input_or_in_the_first_steps() {
    let at_start = ("train.noise_start_fraction", "1.0");
    for (steps, changes) in [("1", &[][..]), ("12", &[at_start][..])] {
        let mut all = vec![
            ("data.crop", "32"),
            ("data.frames", "3"),
            ("train.steps", steps),
            ("train.checkpoint", "1"),
            ("validation.frames", "3"),
            ("validation.crop", "32"),
        ];
        all.extend(changes);
        let all: Vec<_> = all.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
        let text = include_str!("../../../tests/golden/tiny.toml");
        let recipe = Recipe::parse(text, "tests/golden", &all).unwrap();
        let network = Diffusion::init(&recipe, &Device::flex()).unwrap();
        assert_eq!(told_in(&recipe, network), Vec::<Vec<String>>::new(), "{steps} steps");
    }
}
