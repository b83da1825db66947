//! The diffusion that encodes a window once, as it learns.

use super::diffusion::{Batch, Example, noisy_images, perceptual_loss, previous_timestep};
use super::{Context, Learner, Loss, Origin, WeightedSum, learning, load_fitting, save_described};
use crate::burst_cache::BurstSampler;
use crate::loss::log_mean_square;
use crate::parameters::gradients;
use crate::recipe::Recipe;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use qudi_core::restorer::Restorer;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::state::DiffusionState;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{DiffusionRestorer, SampleOptions};
use qudi_model::window::{EncodedWindow, Window};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, RngExt, SeedableRng};
use std::path::Path;

impl Learner for Window {
    type Batch = Batch;

    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.window()?.uninitialized(device))
    }

    fn init(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.window()?.init(recipe.train.seed, device))
    }

    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        load_fitting(path, &NetworkConfig::Window(recipe.network.window()?.clone()), device)
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Batch> {
        Batch::draw(recipe, bursts, number)
    }

    fn upload(batch: &mut Batch, device: &Device) {
        batch.upload(device);
    }

    fn parts(batch: Batch, count: usize) -> Vec<Batch> {
        batch.parts(count)
    }

    fn loss<'a>(&'a self, batch: &'a Batch, context: &Context<'a>) -> Result<Loss<'a>> {
        let train = &context.recipe.train;
        let conditioning = batch.conditioning(context.device);
        let example = batch.example(&conditioning);
        let mut random = ChaCha8Rng::seed_from_u64(train.seed);
        random.set_stream(batch.number);
        // Half of all batches start from nothing, as sampling does.
        let from_nothing = random.next_u64() & 1 == 0;
        let passes = random.random_range(1..=train.passes);
        let encoded = self.encode(&conditioning, passes)?;
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        let truth = example.truth.clone() * 2.0 - 1.0;
        let (x0_prev, has_previous) = if from_nothing {
            (truth.zeros_like(), vec![false; batch.len()])
        } else {
            first_estimate(self, &encoded, &example, truth.clone(), &schedule)
        };
        let state = DiffusionState {
            x_t: noisy_images(&example, truth.clone(), example.timesteps),
            x0_prev,
            has_previous,
            timesteps: example.timesteps.to_vec(),
        };
        let prediction = self.predict(&encoded, &state, &schedule);
        let weights = train.loss();
        let mut sum = WeightedSum::default();
        // Errors in units of what they usually are: no light level drowns another.
        let error = (prediction.x0.clone() - truth.clone()) / prediction.c_out;
        sum.add("prediction", weights.prediction, log_mean_square(error));
        if let Some(lpips) = context.perceptual {
            let images = (prediction.x0 + 1.0) * 0.5;
            let quiet = with_little_noise(example.timesteps, &schedule);
            let of_batch = with_little_noise(batch.timesteps_of_all(), &schedule);
            let share = batch.share(quiet.len(), of_batch.len());
            let distance = perceptual_loss(lpips, &images, &example, &quiet) * share;
            sum.add("perceptual", weights.perceptual, distance);
        }
        let error = (encoded.restored.clone() * 2.0 - 1.0 - truth) / encoded.error_sigma().clone();
        sum.add("pre", weights.pre, log_mean_square(error));
        let frames = conditioning.frames;
        let flows = encoded.flow.iter().map(|flow| flow.warping_error(&example.truth, frames));
        // Batches whose motion is matched have none.
        if let Some(flow) = flows.reduce(Tensor::add) {
            sum.add("flow", weights.flow, flow);
        }
        let total = sum.total();
        Ok(Loss {
            total: total.clone(),
            terms: sum.terms,
            gradients: Box::new(move || gradients(self, &total.backward())),
            statistics: Vec::new(),
        })
    }

    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>> {
        let sampling = recipe.sampling();
        let options = SampleOptions {
            steps: sampling.steps,
            spacing: sampling.spacing,
            precision: recipe.train.precision,
            ..SampleOptions::default()
        };
        let config = recipe.network.window()?.clone();
        let model = recipe.model(self.clone(), config);
        Ok(Box::new(DiffusionRestorer::new(model, options, device)?))
    }

    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()> {
        let sizes = NetworkConfig::Window(recipe.network.window()?.clone());
        save_described(self, sizes, Some(recipe.sampling()), recipe, origin, path)
    }

    fn learns(&self, recipe: &Recipe) -> Vec<bool> {
        learning(self, recipe)
    }

    /// Steps of Muon have full size whatever the gradient: outputs and flow, whose gradients are noise at
    /// first, would walk at random.
    fn prefers_adam(name: &str) -> bool {
        name.starts_with("flow.") || name.ends_with("out.weight")
    }
}

/// Returns the samples whose noise hides little: only there the prediction is about what the sampler leaves.
fn with_little_noise(timesteps: &[usize], schedule: &NoiseSchedule) -> Vec<usize> {
    /// Noise over signal in images from -1 to 1, about what one step leaves wrong.
    const LITTLE: f64 = 0.1;
    let quietest = schedule.timestep_with_noise(LITTLE);
    (0..timesteps.len()).filter(|&n| timesteps[n] <= quietest).collect()
}

/// Makes the network's own estimate from noisier images, without gradient; none at the noisiest timestep,
/// where sampling begins.
fn first_estimate(
    network: &Window,
    encoded: &EncodedWindow,
    example: &Example<'_>,
    truth: Tensor<4>,
    schedule: &NoiseSchedule,
) -> (Tensor<4>, Vec<bool>) {
    let timesteps = example.timesteps;
    let has_previous: Vec<bool> = timesteps.iter().map(|&t| t < NUM_TIMESTEPS - 1).collect();
    if !has_previous.contains(&true) {
        return (truth.zeros_like(), has_previous);
    }
    let earlier: Vec<usize> = timesteps.iter().map(|&t| previous_timestep(t)).collect();
    let x_t = noisy_images(example, truth, &earlier).inner();
    let state = DiffusionState {
        x0_prev: x_t.zeros_like(),
        x_t,
        has_previous: vec![false; timesteps.len()],
        timesteps: earlier,
    };
    let estimate = network.valid().predict(&encoded.inner(), &state, schedule).x0;
    (Tensor::from_inner(estimate.clamp(-1.0, 1.0)), has_previous)
}
