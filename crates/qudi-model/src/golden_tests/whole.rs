//! The whole diffusion, and ten sampling steps with it.

use super::diffusion::config;
use super::{compare, flex, reference_parameter};
use crate::cases::{self, File};
use crate::diffusion::sampler::{Sampler, Step, sample};
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::timesteps::{NUM_TIMESTEPS, TimestepSpacing};
use crate::diffusion::{Conditioning, Simulated};
use crate::init_parameters;
use crate::sensor::{RESPONSE_LEVELS, SENSOR_NUMBERS, sensor_numbers};
use burn::tensor::{Device, Tensor};
use qudi_core::Size;
use qudi_core::restorer::Acquisition;
use qudi_layers::tensor::{read, to_tensor};

/// Computes the squared error plus 0.01 of the total variation of the error, as the reference computes it.
fn reconstruction(p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
    let error = p - q;
    let [_, _, height, width] = error.dims();
    let difference = |axis: usize, size: usize| {
        let part = |first| error.clone().narrow(axis, first, size - 1);
        (part(1) - part(0)).abs().mean()
    };
    let variation = difference(3, width) + difference(2, height);
    error.powi_scalar(2).mean() + variation * 0.01
}

/// The paper's system, and the one that predicts corrections.
#[test]
fn whole_network_matches_pytorch() {
    for name in ["paper", "correction"] {
        let file = File::open(&format!("network/{name}"));
        let case = file.case(name);
        let device = flex();
        let network = init_parameters(config(&case).init(0, &device), reference_parameter);
        let input = |name: &str| -> Tensor<4> { case.input(name, &device).require_grad() };
        let [u, y, y_sim, u_sim, x_t, x0_prev] =
            ["u", "y", "y_sim", "u_sim", "x_t", "x0_prev"].map(input);
        let conditioning = Conditioning {
            counts: y.clone(),
            linear_estimate: u.clone(),
            sensor: case.input("sensor", &device),
            response: Tensor::zeros([1, RESPONSE_LEVELS], &device),
            frames: case.number("frames"),
            motion: Vec::new(),
        };
        let exists: Vec<bool> = case.values("flag").iter().map(|&flag| flag > 0.0).collect();
        let has_previous = exists.clone();
        let simulated = Simulated { y: y_sim.clone(), u: u_sim.clone(), exists };
        let timesteps = case.values("t").iter().map(|&t| t as usize).collect();
        let state =
            DiffusionState { x_t: x_t.clone(), x0_prev: x0_prev.clone(), has_previous, timesteps };
        let encoded = network.encode(&conditioning);
        let prediction = network.forward(&encoded, Some(&simulated), &state, None);
        case.check_output("x0", prediction.x0.clone().inner());
        case.check_output("d", prediction.d.clone().inner());
        case.check_output("to_next", prediction.flows.to_next.clone().inner());
        case.check_output("to_prev", prediction.flows.to_prev.clone().inner());
        let truth: Tensor<4> = case.input("truth", &device);
        let image = (prediction.x0 + 1.0) * 0.5;
        let loss = reconstruction(image, truth.clone()) + reconstruction(prediction.d, truth) * 0.2;
        case.check_output("loss", loss.clone().inner());
        let grads = loss.backward();
        let inputs = [
            ("u", &u),
            ("y", &y),
            ("y_sim", &y_sim),
            ("u_sim", &u_sim),
            ("x_t", &x_t),
            ("x0_prev", &x0_prev),
        ];
        for (name, tensor) in inputs {
            case.check_gradient(name, tensor.grad(&grads).unwrap());
        }
        compare(&case, &grads, &network, "");
    }
}

#[test]
fn sampler_weights_match_numpy() {
    let file = File::open("network/steps");
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    for (name, sampler) in [("ddim", Sampler::Ddim), ("ancestral", Sampler::Ancestral)] {
        let expected = file.f64s(name);
        let steps = sampler.steps(&schedule, 10, TimestepSpacing::Linear);
        assert_eq!(steps.len(), 10);
        for (step, expected) in steps.iter().zip(expected.chunks_exact(3)) {
            let got = [step.clean, step.noisy, step.sigma];
            for (got, expected) in got.iter().zip(expected) {
                assert!((got - expected).abs() < 1e-9, "{name}: {step:?}, reference {expected}");
            }
        }
    }
}

/// Ten steps from noise to picture with the reference's noise and its simulated counts.
#[test]
fn ten_sampling_steps_match_pytorch() {
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let size = Size { height: 32, width: 32 };
    for name in ["paper", "correction"] {
        let file = File::open(&format!("sampling/{name}"));
        let case = file.case("sample");
        let device = Device::flex();
        let config = config(&case);
        let network = init_parameters(config.init(0, &device), reference_parameter);
        let frames = case.number("frames");
        let sensor: Vec<f32> = serde_json::from_value(case.about["sensor"].clone()).unwrap();
        let ours = paper_numbers();
        assert!(ours.iter().zip(&sensor).all(|(a, b)| (a - b).abs() < 1e-6), "{ours:?}");
        let planes = |counts: &[u8], table: &[f32]| {
            let y = counts.iter().map(|&c| f32::from(c) / 7.0).collect();
            let u = counts.iter().map(|&c| table[usize::from(c)]).collect();
            (to_tensor(y, size, &device), to_tensor(u, size, &device))
        };
        let (counts, linear_estimate) = planes(&file.bytes("counts"), &file.f32s("u_table"));
        let sensor = Tensor::<1>::from_floats(sensor.as_slice(), &device).unsqueeze();
        let motion = Vec::new();
        let response = Tensor::zeros([1, RESPONSE_LEVELS], &device);
        let conditioning =
            Conditioning { counts, linear_estimate, sensor, response, frames, motion };
        let encoded = network.encode(&conditioning);
        let (simulated, tables) = (file.bytes("simulated"), file.f32s("u_sim_table"));
        let count = frames * size.pixels();
        let mut flows = None;
        let (expected_x, expected_x0) = (file.f32s("x"), file.f32s("x0"));
        let close = |what: &str, got: &[f32], expected: &[f32], step: usize| {
            for i in 0..64 {
                let difference = got[61 * i] - expected[64 * (step - 1) + i];
                assert!(difference.abs() < 1e-3, "{name}, step {step}: {what} by {difference}");
            }
        };
        let predict = |step: &Step, x: &[f32], x0: &[f32]| {
            let k = step.number;
            if k > 1 {
                close("x", x, &expected_x, k - 1);
            }
            let simulated = k.checked_sub(2).map(|n| {
                let counts = &simulated[n * count..(n + 1) * count];
                let (y, u) = planes(counts, &tables[8 * n..8 * n + 8]);
                Simulated { y, u, exists: vec![true] }
            });
            if config.flow.steps.contains(&k) {
                flows = None;
            }
            let state = DiffusionState {
                x_t: to_tensor(x.to_vec(), size, &device),
                x0_prev: to_tensor(x0.to_vec(), size, &device),
                has_previous: vec![k > 1],
                timesteps: vec![step.timestep],
            };
            let result = network.forward(&encoded, simulated.as_ref(), &state, flows.take());
            flows = Some(result.flows);
            let x0 = read(result.x0.clamp(-1.0, 1.0))?;
            close("x0", &x0, &expected_x0, k);
            Ok::<_, qudi_core::Error>(x0)
        };
        let noise = |k: usize| cases::gaussian(&format!("noise.{k}"), count);
        let steps = Sampler::Ddim.steps(&schedule, 10, TimestepSpacing::Linear);
        let fresh = |step: &Step| Ok(noise(step.number));
        let x0 = sample(&steps, noise(0), predict, fresh).unwrap();
        let last = file.f32s("x0_last");
        let worst = x0.iter().zip(&last).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-3, "{name}: the result is off by {worst}");
    }
}

/// Returns the numbers of the paper's sensor at its lowest light.
fn paper_numbers() -> [f32; SENSOR_NUMBERS] {
    let sensor = qudi_core::sensor::Sensor::load("qudi-paper").unwrap();
    sensor_numbers(&Acquisition::new(sensor, 3.25, 0.45).unwrap())
}
