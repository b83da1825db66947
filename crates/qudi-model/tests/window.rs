//! The diffusion that encodes a window once.
#![allow(clippy::unwrap_used)]

use burn::module::Module;
use burn::tensor::{Device, Distribution, Tensor};
use qudi_core::Size;
use qudi_core::atomic_file::Overwrite;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::Sensor;
use qudi_layers::tensor::{read, to_tensor};
use qudi_layers::{Provenance, init_parameters, parameter_shapes};
use qudi_model::checkpoint::{Description, Precision, load, save};
use qudi_model::config::NetworkConfig;
use qudi_model::counts::CountPlanes;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::state::DiffusionState;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{BurstMotion, Conditioning};
use qudi_model::regression::Regression;
use qudi_model::sensor::{response_tensor, sensor_tensor};
use qudi_model::window::{Window, WindowConfig};
use std::collections::HashMap;
use std::sync::Arc;

const CONFIG: WindowConfig = WindowConfig {
    widths: [8, 8, 8],
    flow: [4, 4, 4],
    state: 8,
    cell_blocks: 1,
    linear_entries: true,
};

fn conditioning(frames: usize, device: &Device) -> Conditioning {
    let sensor = Sensor::load("qudi-paper").unwrap();
    let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap();
    let images = || Tensor::random([frames, 1, 16, 24], Distribution::Uniform(0.0, 1.0), device);
    Conditioning {
        counts: images(),
        linear_estimate: images(),
        sensor: sensor_tensor(&acquisition, device),
        response: response_tensor(&acquisition, device),
        frames,
        motion: Vec::new(),
    }
}

/// Returns a conditioning that comes with the search for motion in counts: a texture that moves by `speed`
/// pixels a frame.
fn matched(frames: usize, speed: f32, device: &Device) -> Conditioning {
    let size = Size { height: 16, width: 24 };
    let sensor = Sensor::load("qudi-paper").unwrap();
    let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap();
    let count = |t: usize, i: usize| {
        let x = (i % size.width) as f32 - speed * t as f32;
        let y = (i / size.width) as f32;
        (3.0 + 2.0 * (0.9 * x).sin() + 2.0 * (0.7 * y + 0.3 * x).cos()).clamp(0.0, 7.0) as u16
    };
    let counts: Vec<Vec<u16>> =
        (0..frames).map(|t| (0..size.pixels()).map(|i| count(t, i)).collect()).collect();
    let motion = BurstMotion::new(BurstView { size, frames: &counts }, &acquisition);
    let planes = CountPlanes::new(BurstView { size, frames: &counts }, &acquisition);
    Conditioning {
        counts: to_tensor(planes.y, size, device),
        linear_estimate: to_tensor(planes.u, size, device),
        motion: vec![Arc::new(motion)],
        ..conditioning(frames, device)
    }
}

fn state(frames: usize, timestep: usize, device: &Device) -> DiffusionState {
    let noise = || Tensor::random([frames, 1, 16, 24], Distribution::Normal(0.0, 1.0), device);
    DiffusionState {
        x_t: noise(),
        x0_prev: noise() * 0.1,
        has_previous: vec![false],
        timesteps: vec![timestep],
    }
}

fn predicted(network: &Window, conditioning: &Conditioning, state: &DiffusionState) -> Vec<f32> {
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    read(network.predict(&network.encode(conditioning, 1).unwrap(), state, &schedule).x0).unwrap()
}

#[test]
fn the_first_step_does_not_depend_on_the_noise_and_later_ones_do() {
    let device = Device::flex();
    let network = CONFIG.init(1, &device);
    let conditioning = conditioning(3, &device);
    let predict = |timestep| predicted(&network, &conditioning, &state(3, timestep, &device));
    let last = NUM_TIMESTEPS - 1;
    assert_eq!(predict(last), predict(last));
    let (one, other) = (predict(50), predict(50));
    let difference = one.iter().zip(&other).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(difference > 0.01, "{difference}");
}

/// Passes find other flow, and with it another picture.
#[test]
fn a_second_pass_changes_what_frames_are_fused_along() {
    let device = Device::flex();
    let network = CONFIG.init(1, &device);
    let conditioning = conditioning(3, &device);
    let state = state(3, NUM_TIMESTEPS - 1, &device);
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let [one, two] = [1, 2].map(|passes| {
        let encoded = network.encode(&conditioning, passes).unwrap();
        read(network.predict(&encoded, &state, &schedule).x0).unwrap()
    });
    assert!(two.iter().all(|value| value.is_finite()));
    assert_ne!(one, two);
}

/// Two bursts side by side are followed along their own motion, as each of them alone.
#[test]
fn matched_motion_belongs_to_its_burst() {
    let device = Device::flex();
    let network = CONFIG.init(1, &device);
    let bursts = [0.0, 2.0].map(|speed| matched(4, speed, &device));
    let state = state(4, NUM_TIMESTEPS - 1, &device);
    let alone = bursts.each_ref().map(|burst| predicted(&network, burst, &state));
    let both = |of: fn(&Conditioning) -> &Tensor<4>| {
        Tensor::cat(bursts.iter().map(|burst| of(burst).clone()).collect(), 0)
    };
    let joined = Conditioning {
        counts: both(|burst| &burst.counts),
        linear_estimate: both(|burst| &burst.linear_estimate),
        sensor: bursts[0].sensor.clone().repeat_dim(0, 2),
        response: bursts[0].response.clone().repeat_dim(0, 2),
        frames: 4,
        motion: bursts.iter().flat_map(|burst| burst.motion.clone()).collect(),
    };
    let twice = |x: &Tensor<4>| x.clone().repeat_dim(0, 2);
    let state = DiffusionState {
        x_t: twice(&state.x_t),
        x0_prev: twice(&state.x0_prev),
        has_previous: vec![false; 2],
        timesteps: vec![NUM_TIMESTEPS - 1; 2],
    };
    let together = predicted(&network, &joined, &state);
    let pairs = together.iter().zip(alone.iter().flatten());
    assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-5), "bursts mix");
    let learnt = Conditioning { motion: Vec::new(), ..bursts[1].clone() };
    let state = DiffusionState {
        x_t: state.x_t.narrow(0, 0, 4),
        x0_prev: state.x0_prev.narrow(0, 0, 4),
        has_previous: vec![false],
        timesteps: vec![NUM_TIMESTEPS - 1],
    };
    assert_ne!(predicted(&network, &learnt, &state), alone[1], "the motion changes nothing");
}

/// With little noise, the noisy image is the answer.
#[test]
fn the_prediction_follows_an_image_without_noise() {
    let device = Device::flex();
    let network = CONFIG.init(1, &device);
    let conditioning = conditioning(3, &device);
    let truth = Tensor::<4>::random([3, 1, 16, 24], Distribution::Uniform(-1.0, 1.0), &device);
    let signal = NoiseSchedule::cosine(NUM_TIMESTEPS).alpha_bar(Some(0)).sqrt() as f32;
    let state = DiffusionState { x_t: truth.clone() * signal, ..state(3, 0, &device) };
    let got = predicted(&network, &conditioning, &state);
    let worst = got.iter().zip(read(truth).unwrap()).map(|(a, b)| (a - b).abs());
    let worst = worst.fold(0.0, f32::max);
    assert!(worst < 0.1, "{worst}");
}

/// But for the flow where matched motion takes its place.
#[test]
fn every_parameter_has_a_gradient() {
    let device = Device::flex().autodiff();
    for conditioning in [conditioning(4, &device), matched(4, 1.0, &device)] {
        for passes in [1, 2] {
            every_parameter_has_a_gradient_in(passes, &conditioning);
        }
    }
}

fn every_parameter_has_a_gradient_in(passes: usize, conditioning: &Conditioning) {
    let device = Device::flex().autodiff();
    let network = CONFIG.init(1, &device);
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let encoded = network.encode(conditioning, passes).unwrap();
    let mut state = state(4, 60, &device);
    state.has_previous = vec![true];
    let x0 = network.predict(&encoded, &state, &schedule).x0;
    let truth = conditioning.linear_estimate.clone();
    let flow = encoded.flow.iter().map(|flow| flow.warping_error(&truth, 4));
    let loss = flow.fold(x0.powi_scalar(2).mean(), Tensor::add);
    let gradients = loss.backward();
    let lists = largest_gradients(&network, &gradients);
    for ((name, _), largest) in parameter_shapes(&network).iter().zip(lists) {
        let learns = conditioning.motion.is_empty() || !name.starts_with("flow.");
        assert_eq!(largest > 0.0, learns, "{name}, pass {passes}");
    }
}

/// Returns the values of all parameters, in the order of their names.
fn parameters(network: &Window) -> Vec<Tensor<1>> {
    struct Values(Vec<Tensor<1>>);
    impl burn::module::ModuleVisitor for Values {
        fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
            self.0.push(param.val().inner().flatten(0, D - 1));
        }
    }
    let mut values = Values(Vec::new());
    network.visit(&mut values);
    values.0
}

/// Returns the largest magnitude of every parameter's gradient.
fn largest_gradients(network: &Window, gradients: &burn::tensor::Gradients) -> Vec<f32> {
    struct Largest<'a>(&'a burn::tensor::Gradients, Vec<f32>);
    impl burn::module::ModuleVisitor for Largest<'_> {
        fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
            let largest = param
                .val()
                .grad(self.0)
                .map_or(0.0, |gradient| gradient.abs().max().into_scalar::<f32>());
            self.1.push(largest);
        }
    }
    let mut largest = Largest(gradients, Vec::new());
    network.visit(&mut largest);
    largest.1
}

/// Where the first units of a coarser level are off for every input, a ReLU lets no gradient pass; without it
/// the level learns.
#[test]
fn levels_with_linear_entries_cannot_go_dead() {
    let device = Device::flex().autodiff();
    let conditioning = matched(4, 1.0, &device);
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    for linear_entries in [true, false] {
        let config = WindowConfig { linear_entries, ..CONFIG };
        let network = config.init(1, &device);
        let names = parameter_shapes(&network);
        let mut values: HashMap<String, Vec<f32>> = names
            .iter()
            .zip(parameters(&network))
            .map(|((name, _), values)| (name.clone(), read(values).unwrap()))
            .collect();
        for part in ["pre", "unet"] {
            let bias = format!("{part}.hourglass.decoder.1.entry.bias");
            values.get_mut(&bias).unwrap().fill(-10.0);
        }
        let network = init_parameters(network, |name, _| values[name].clone());
        let encoded = network.encode(&conditioning, 1).unwrap();
        let x0 = network.predict(&encoded, &state(4, 60, &device), &schedule).x0;
        let largest = largest_gradients(&network, &x0.powi_scalar(2).mean().backward());
        for ((name, _), largest) in names.iter().zip(largest) {
            if name.contains(".hourglass.encoder.2.") || name.contains(".hourglass.up.1.") {
                assert_eq!(largest > 0.0, linear_entries, "{name}: {largest}");
            }
        }
    }
}

/// Networks of earlier programs lack parts, and are not taken for this one.
#[test]
fn weights_that_lack_a_part_are_refused_by_its_name() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("window.safetensors");
    let network = CONFIG.init(1, &device);
    save(&network, &description(), Precision::Single, &path, Overwrite::Yes).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for name in ["unet.gate.weight", "agreement.out.bias"] {
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
        let kept = file.tensors().into_iter().filter(|(kept, _)| kept != name);
        let former = safetensors::serialize(kept, header.metadata().clone()).unwrap();
        std::fs::write(&path, former).unwrap();
        let error = load::<Window>(&path, &device).unwrap_err();
        assert!(error.to_string().contains(&format!("`{name}` is missing")), "{error}");
    }
}

fn description() -> Description {
    Description {
        preset: None,
        network: NetworkConfig::Window(CONFIG),
        window: 11,
        passes: 1,
        provenance: Provenance {
            program: "test".into(),
            sensors: vec!["qudi-paper".into()],
            ppp: [1.0, 30.0],
            data: Vec::new(),
            steps: 1,
            commit: None,
            licence: "MIT".into(),
            recipes: Vec::new(),
        },
        sampling: None,
    }
}

/// Both orders of computation belong to one method: the help of the error must name a method that exists.
#[test]
fn weights_of_another_kind_are_refused_with_the_method_that_takes_them() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("window.safetensors");
    let description = description();
    let network = CONFIG.init(1, &device);
    save(&network, &description, Precision::Half, &path, Overwrite::Yes).unwrap();
    let (_, read) = load::<Window>(&path, &device).unwrap();
    assert_eq!(read.network, description.network);
    let error = load::<Regression>(&path, &device).unwrap_err();
    assert!(error.to_string().contains("a window diffusion"), "{error}");
    assert!(format!("{error:?}").contains("--method qudi-diffusion,"), "{error:?}");
}
