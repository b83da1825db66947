//! The inputs of a training pass: the noisy images, and what the step before would have left.

use super::Example;
use super::timesteps::previous_timestep;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_core::{Error, Result, Size};
use qudi_layers::tensor::{read, to_tensor};
use qudi_model::counts::CountPlanes;
use qudi_model::diffusion::forward_model::ForwardModel;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::state::{DiffusionState, per_image};
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{Diffusion, Part, Simulated};
use rayon::prelude::*;

/// Self-conditioning: a first pass makes the estimate that the network is given, as after the first step of
/// sampling (Chen et al. 2023, "Analog Bits", section 3.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SelfConditioning {
    /// The network starts from nothing.
    Off,
    /// The network is given its own estimate from a noisier image, and that estimate measured again with
    /// photons of this seed.
    On(u64),
}

/// Computes the network's inputs at an example's timesteps.
pub(super) fn network_inputs(
    network: &Diffusion,
    example: &Example<'_>,
    self_conditioning: SelfConditioning,
) -> Result<(DiffusionState, Option<Simulated>)> {
    let timesteps = example.timesteps;
    let truth = example.truth.clone() * 2.0 - 1.0;
    let sees = |part| !network.ablation().removes(part);
    let (x0_prev, has_previous, simulated) = match self_conditioning {
        // Where sampling begins, nothing comes before.
        SelfConditioning::On(seed) if timesteps.iter().any(|&t| t < NUM_TIMESTEPS - 1) => {
            let previous: Vec<usize> = timesteps.iter().map(|&t| previous_timestep(t)).collect();
            let x_t = noisy_images(example, truth.clone(), &previous);
            let (x0_prev, simulated) = first_estimate(network, example, (x_t, previous), seed)?;
            let is_seen = sees(Part::SelfConditioning);
            let has_previous = simulated.exists.iter().map(|&exists| exists && is_seen).collect();
            (x0_prev, has_previous, Some(simulated).filter(|_| sees(Part::ForwardModel)))
        }
        _ => (example.truth.zeros_like(), vec![false; timesteps.len()], None),
    };
    let (x_t, timesteps) = (noisy_images(example, truth, timesteps), timesteps.to_vec());
    let state = DiffusionState { x_t, x0_prev, has_previous, timesteps };
    Ok((state, simulated))
}

/// Adds noise to clean images in [-1, 1]: the example's noise of these timesteps, one per burst.
pub(in crate::learner) fn noisy_images(
    example: &Example<'_>,
    clean: Tensor<4>,
    timesteps: &[usize],
) -> Tensor<4> {
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let level = |f: fn(f64) -> f64| {
        let values = timesteps.iter().map(|&t| f(schedule.alpha_bar(Some(t))) as f32).collect();
        per_image(values, clean.dims()[0], &clean.device()).expand(clean.dims())
    };
    let (signal, noise) = (level(f64::sqrt), level(|a| (1.0 - a).sqrt()));
    clean * signal + example.noise.clone() * noise
}

/// Makes the network's own estimate from the noisier images `x_t` of the timesteps `previous`, without
/// gradient, and its simulated measurement. Bursts at the noisiest timestep have neither: there sampling
/// starts.
fn first_estimate(
    network: &Diffusion,
    example: &Example<'_>,
    (x_t, previous): (Tensor<4>, Vec<usize>),
    seed: u64,
) -> Result<(Tensor<4>, Simulated)> {
    let device = example.truth.device();
    let conditioning = example.conditioning.inner();
    let network = network.valid();
    let x_t = x_t.inner();
    let has_previous = vec![false; previous.len()];
    let x0_prev = x_t.zeros_like();
    let state = DiffusionState { x_t, x0_prev, has_previous, timesteps: previous };
    let prediction = network.forward(&network.encode(&conditioning), None, &state, None);
    let [_, _, height, width] = example.truth.dims();
    let size = Size { height, width };
    let mut x0 = read(prediction.x0.clamp(-1.0, 1.0))?;
    if !x0.iter().all(|value| value.is_finite()) {
        return Err(Error::request(
            "the network's first estimate is not finite: the last checkpoint is good",
            "self-conditioning",
            "lower train.lr or train.clip, and resume from the checkpoint",
        ));
    }
    let burst = conditioning.frames * size.pixels();
    let exists: Vec<bool> = example.timesteps.iter().map(|&t| t < NUM_TIMESTEPS - 1).collect();
    let measured = |(number, x0): (usize, &mut [f32])| {
        if !exists[number] {
            x0.fill(0.0);
            return Ok(CountPlanes { y: vec![0.0; burst], u: vec![0.0; burst] });
        }
        let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
        let model = ForwardModel::new(&example.acquisitions[number], example.timesteps[number]);
        let first = (number * conditioning.frames) as u64;
        model.measure(&images, size, first, seed)
    };
    let measured: Result<Vec<CountPlanes>> =
        x0.par_chunks_exact_mut(burst).enumerate().map(measured).collect();
    let mut planes = CountPlanes::default();
    measured?.into_iter().for_each(|more| planes.extend(more));
    let tensor = |values| to_tensor(values, size, &device);
    let simulated = Simulated { y: tensor(planes.y), u: tensor(planes.u), exists };
    Ok((tensor(x0), simulated))
}
