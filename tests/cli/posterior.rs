//! The built-in diffusion draws from a posterior: its noise matters, its draws spread about as far as it
//! errs, and they carry no grid. Bounds are what the shipped weights keep (docs/model-card.md), with room
//! for chance.

use crate::support::{run, scratch};
use burn::tensor::{Device, Tensor};
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::Sensor;
use qudi_layers::tensor::{read, to_tensor};
use qudi_model::checkpoint::load;
use qudi_model::counts::CountPlanes;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::state::DiffusionState;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{BurstMotion, Conditioning};
use qudi_model::sensor::{response_tensor, sensor_tensor};
use qudi_model::window::Window;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const FRAMES: usize = 11;
const SIDE: usize = 64;
const PPP: f64 = 3.25;

/// Creates a folder with a burst of dead leaves, `b.npy`, and its truth, `t.npy`.
fn burst(name: &str) -> PathBuf {
    burst_of("dead-leaves", name)
}

/// Creates the same of another scene.
fn burst_of(scene: &str, name: &str) -> PathBuf {
    let folder = scratch(name);
    let scene = format!("scene:{scene} --size {SIDE}x{SIDE} --frames {FRAMES}");
    run(&folder, &format!("simulate {scene} --ppp {PPP} --seed 5 -o b.npy --truth t.npy -q"));
    folder
}

/// Returns the last values of an array, as many as the burst has pixels.
fn values(path: &Path) -> Vec<f32> {
    last_values(path, FRAMES * SIDE * SIDE)
}

fn last_values(path: &Path, count: usize) -> Vec<f32> {
    let bytes = std::fs::read(path).unwrap();
    let data = &bytes[bytes.len() - 4 * count..];
    data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

fn restored(folder: &Path, options: &str) -> Vec<f32> {
    run(
        folder,
        &format!("restore b.npy --method qudi-diffusion --device cpu -o r.npy -q -f {options}"),
    );
    values(&folder.join("r.npy"))
}

fn rms(values: impl Iterator<Item = f32>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for value in values {
        sum += f64::from(value).powi(2);
        count += 1.0;
    }
    f64::sqrt(sum / count)
}

fn rms_difference(a: &[f32], b: &[f32]) -> f64 {
    rms(a.iter().zip(b).map(|(a, b)| a - b))
}

/// Returns the rms of what alternates from pixel to pixel along both axes: the power around the Nyquist
/// frequency.
fn alternating(frames: &[f32]) -> f64 {
    let at = |frame: usize, y: usize, x: usize| frames[(frame * SIDE + y) * SIDE + x];
    let places = (0..FRAMES).flat_map(|f| (0..SIDE - 3).map(move |y| (f, y)));
    let places = places.flat_map(|(f, y)| (0..SIDE - 3).map(move |x| (f, y, x)));
    let sign = |k: usize| if k.is_multiple_of(2) { 1.0 } else { -1.0 };
    rms(places.map(|(f, y, x)| {
        let along = |dx: usize, dy: usize| -> f32 {
            (0..4).map(|k| sign(k) * at(f, y + k * dy, x + k * dx)).sum()
        };
        along(1, 0) + along(0, 1)
    }))
}

#[test]
fn draws_of_the_built_in_diffusion_spread_about_as_far_as_it_errs() {
    let folder = burst("posterior-draws");
    let truth = values(&folder.join("t.npy"));
    let mean = restored(&folder, "--steps 1");
    let error = rms_difference(&mean, &truth);
    let draws = [1, 2].map(|seed| restored(&folder, &format!("--steps 10 --seed {seed}")));
    let spread = rms_difference(&draws[0], &draws[1]) / 2f64.sqrt() / error;
    assert!((0.4..1.2).contains(&spread), "two draws differ by {spread} of the error");
    let grid = (alternating(&draws[0]) / alternating(&truth)).powi(2);
    assert!(grid < 2.0, "{grid} of the truth's power at the Nyquist frequency");
    let share = share_within_one_sigma(&folder, FRAMES * SIDE * SIDE);
    assert!((0.35..0.76).contains(&share), "{share} of all pixels lie within one sigma");
}

/// Returns the share of pixels that the mean of eight draws errs on by at most their standard deviation.
fn share_within_one_sigma(folder: &Path, count: usize) -> f64 {
    restored(folder, "--steps 10 --samples 8 --uncertainty d.npy");
    let [mean, sigma, truth] =
        ["r.npy", "d.npy", "t.npy"].map(|name| last_values(&folder.join(name), count));
    let inside = (0..count).filter(|&k| (mean[k] - truth[k]).abs() <= sigma[k]).count();
    inside as f64 / count as f64
}

/// The noise of several draws moves with the scene. With noise of every frame's own, 0.26 of all pixels lie
/// within one sigma of their mean.
#[test]
fn several_draws_of_the_built_in_diffusion_show_how_far_they_err() {
    let folder = scratch("posterior-uncertainty");
    let scene = "scene:chart --size 96x96 --frames 11 --ppp 3.25 --seed 5";
    run(&folder, &format!("simulate {scene} -o b.npy --truth t.npy -q"));
    let share = share_within_one_sigma(&folder, FRAMES * 96 * 96);
    assert!((0.45..0.76).contains(&share), "{share} of all pixels lie within one sigma");
}

/// Restored frames show the motion better than the ones before, so that less is blurred: letters err by 0.97
/// of the first pass's error.
#[test]
fn a_second_pass_of_the_built_in_diffusion_errs_less() {
    let folder = burst_of("text", "posterior-passes");
    let truth = values(&folder.join("t.npy"));
    let [one, two] = [1, 2]
        .map(|passes| rms_difference(&restored(&folder, &format!("--passes {passes}")), &truth));
    assert!(two < 0.985 * one, "{two} after the second pass, {one} after the first");
}

/// Patches that are matched in the counts of all frames show the motion of large things better than the
/// learnt flow: a chart of 128 x 128 errs by 0.92 of its error.
#[test]
fn matched_motion_errs_less_than_the_learnt_flow() {
    let folder = scratch("posterior-flow");
    run(
        &folder,
        "simulate scene:chart --size 128x128 --frames 11 --seed 5 -o b.npy --truth t.npy -q",
    );
    let array = |name: &str| last_values(&folder.join(name), FRAMES * 128 * 128);
    let errors = ["", "--flow matched", "--flow learnt"].map(|flow| {
        restored(&folder, flow);
        rms_difference(&array("r.npy"), &array("t.npy"))
    });
    let [default, matched, learnt] = errors;
    assert!(matched < 0.96 * learnt, "{matched} with matched, {learnt} with learnt flow");
    assert!((default - matched).abs() < 1e-9, "matched is the default");
}

/// Without the noisy image the prediction in the middle of sampling is another one.
#[test]
fn the_built_in_diffusion_looks_at_the_noisy_image() {
    let folder = burst("posterior-lesion");
    let device = Device::flex();
    let size = Size { height: SIDE, width: SIDE };
    let acquisition = Acquisition::new(Sensor::load("qudi-paper").unwrap(), PPP, 0.45).unwrap();
    let bytes = std::fs::read(folder.join("b.npy")).unwrap();
    let counts = &bytes[bytes.len() - FRAMES * SIDE * SIDE..];
    let frames: Vec<Vec<u16>> =
        counts.chunks(SIDE * SIDE).map(|f| f.iter().map(|&c| u16::from(c)).collect()).collect();
    let view = BurstView { size, frames: &frames };
    let planes = CountPlanes::new(view, &acquisition);
    let conditioning = Conditioning {
        counts: to_tensor(planes.y, size, &device),
        linear_estimate: to_tensor(planes.u, size, &device),
        sensor: sensor_tensor(&acquisition, &device),
        response: response_tensor(&acquisition, &device),
        frames: FRAMES,
        motion: vec![Arc::new(BurstMotion::new(view, &acquisition))],
    };
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("weights/diffusion.safetensors");
    let (network, _) = load::<Window>(&weights, &device).unwrap();
    let encoded = network.encode(&conditioning, 1).unwrap();
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let truth = to_tensor(values(&folder.join("t.npy")), size, &device) * 2.0 - 1.0;
    let timestep = schedule.timestep_with_noise(0.1);
    let signal = schedule.alpha_bar(Some(timestep)).sqrt() as f32;
    let predicted = |x_t: Tensor<4>| {
        let state = DiffusionState {
            x0_prev: x_t.zeros_like(),
            x_t,
            has_previous: vec![false],
            timesteps: vec![timestep],
        };
        read(network.predict(&encoded, &state, &schedule).x0).unwrap()
    };
    let (seen, hidden) = (predicted(truth.clone() * signal), predicted(truth.zeros_like()));
    let truth = read(truth).unwrap();
    let [seen_error, error] = [&seen, &hidden].map(|x0| rms_difference(x0, &truth));
    assert!(seen_error < 0.7 * error, "{seen_error} with the noisy image, {error} without");
}
