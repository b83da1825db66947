//! The diffusion as it learns.

mod batch;
mod inputs;
mod recomputation;
mod timesteps;

use super::{Context, Learner, Loss, Origin, WeightedSum, learning, load_fitting, save_described};
use crate::burst_cache::BurstSampler;
use crate::loss::lpips::Lpips;
use crate::loss::{LossForm, reconstruction, relative_reconstruction};
use crate::parameters::gradients;
use crate::recipe::{LossConfig, Recipe};
use burn::tensor::{Device, Tensor};
use inputs::network_inputs;
use qudi_core::Result;
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{Conditioning, Diffusion, DiffusionRestorer, Part, SampleOptions};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use recomputation::{KeptFrames, Predicted, Recomputation};
use std::path::Path;

pub use batch::Batch;
pub use inputs::SelfConditioning;
pub(super) use inputs::noisy_images;
pub use timesteps::TimestepLaw;
pub(super) use timesteps::previous_timestep;

/// The least scale that a pixel's error is divided by, in [-1, 1]: half a step of 8 bits.
const MIN_SCALE: f32 = 0.004;

/// The usual error of pre-denoised frames, in sigmas of the linear estimate's noise.
const USUAL_ERROR: f32 = 0.3;

impl Learner for Diffusion {
    type Batch = Batch;

    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self> {
        let network = recipe.network.diffusion()?.uninitialized(device);
        Ok(network.ablated(&recipe.train.ablate))
    }

    fn init(recipe: &Recipe, device: &Device) -> Result<Self> {
        let network = recipe.network.diffusion()?.init(recipe.train.seed, device);
        Ok(network.ablated(&recipe.train.ablate))
    }

    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        let network: Self = load_fitting(
            path,
            &NetworkConfig::Diffusion(recipe.network.diffusion()?.clone()),
            device,
        )?;
        Ok(network.ablated(&recipe.train.ablate))
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Batch> {
        Batch::draw(recipe, bursts, number)
    }

    fn upload(batch: &mut Batch, device: &Device) {
        batch.upload(device);
    }

    fn loss<'a>(&'a self, batch: &'a Batch, context: &Context<'a>) -> Result<Loss<'a>> {
        let train = &context.recipe.train;
        let conditioning = batch.conditioning(context.device);
        let mut random = ChaCha8Rng::seed_from_u64(train.seed);
        random.set_stream(batch.number);
        // Half of all batches start from nothing, as sampling does.
        let from_nothing = random.next_u64() & 1 == 0;
        let removes = |part| self.ablation().removes(part);
        let needs_no_estimate = removes(Part::ForwardModel) && removes(Part::SelfConditioning);
        let self_conditioning = if from_nothing || needs_no_estimate {
            SelfConditioning::Off
        } else {
            SelfConditioning::On(random.next_u64())
        };
        let example = batch.example(&conditioning);
        let recomputes = train.gradient_checkpointing;
        let perceptual = context.perceptual;
        let terms =
            loss_terms(self, &example, self_conditioning, train.loss(), recomputes, perceptual)?;
        Ok(Loss {
            total: terms.total(),
            terms: terms.terms().to_vec(),
            gradients: Box::new(move || terms.gradients(self, &conditioning)),
            statistics: Vec::new(),
        })
    }

    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>> {
        let sampling = recipe.sampling();
        let options = SampleOptions {
            steps: sampling.steps,
            spacing: sampling.spacing,
            ..SampleOptions::default()
        };
        let config = recipe.network.diffusion()?.clone();
        let model = recipe.model(self.clone(), config);
        Ok(Box::new(DiffusionRestorer::new(model, options, device)?))
    }

    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()> {
        let sizes = NetworkConfig::Diffusion(recipe.network.diffusion()?.clone());
        save_described(self, sizes, Some(recipe.sampling()), recipe, origin, path)
    }

    fn learns(&self, recipe: &Recipe) -> Vec<bool> {
        learning(self, recipe)
    }

    fn idle_layers(recipe: &Recipe) -> &'static [&'static str] {
        let train = &recipe.train;
        let is_first = train.noise_start_fraction() >= 1.0;
        let is_measured_again = !is_first && !train.ablate.removes(Part::ForwardModel);
        if is_measured_again { &[] } else { &["pre.simulated_in"] }
    }
}

/// Bursts to learn from.
///
/// # Shapes
/// - truth, noise: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Example<'a> {
    /// The network's inputs.
    pub conditioning: &'a Conditioning,
    /// The true frames in [0, 1].
    pub truth: Tensor<4>,
    /// Sensor and light of every burst.
    pub acquisitions: &'a [Acquisition],
    /// Standard normal noise.
    pub noise: Tensor<4>,
    /// The timestep of every burst.
    pub timesteps: &'a [usize],
}

/// The terms of the loss and their weighted sum.
#[derive(Clone, Debug)]
pub struct LossTerms {
    sum: WeightedSum,
    /// What is left to do for the gradients, if parts are computed again for them.
    recomputation: Option<Recomputation>,
}

impl LossTerms {
    /// Returns the weighted sum, `[1]`.
    pub fn total(&self) -> Tensor<1> {
        self.sum.total()
    }

    /// Returns the terms by name, unweighted, `[1]` each.
    pub fn terms(&self) -> &[(&'static str, Tensor<1>)] {
        &self.sum.terms
    }

    /// Computes the gradients of the total for all parameters of `network`, in their order, `[values]` each.
    /// `conditioning` is the one of the example.
    pub fn gradients(&self, network: &Diffusion, conditioning: &Conditioning) -> Vec<Tensor<1>> {
        match &self.recomputation {
            Some(recomputation) => recomputation.gradients(network, conditioning),
            None => gradients(network, &self.total().backward()),
        }
    }
}

/// Computes the loss of `network`, which is on an autodiff device, on an example on the same device. With
/// `recomputes`, pre-denoiser and U-Net are computed again for their gradients, image by image.
///
/// # Errors
/// [`Error`](qudi_core::Error) if the device fails or a sensor is impossible.
pub fn loss_terms(
    network: &Diffusion,
    example: &Example<'_>,
    self_conditioning: SelfConditioning,
    weights: LossConfig,
    recomputes: bool,
    perceptual: Option<&Lpips>,
) -> Result<LossTerms> {
    let Example { conditioning, truth, .. } = example;
    let (state, simulated) = network_inputs(network, example, self_conditioning)?;
    let simulated = simulated.as_ref();
    let kept = recomputes.then(|| KeptFrames::new(network, conditioning, simulated));
    let predenoised = match &kept {
        Some(kept) => kept.frames(),
        None => network.predenoise(conditioning, simulated),
    };
    let measurement = network.encode_measurement(conditioning);
    let (fused, flows) = network.fuse(&measurement, predenoised, simulated, &state, None);
    let d = fused.d().clone();
    let predicted = recomputes.then(|| Predicted::new(network, fused.clone()));
    let (x0, scale) = match &predicted {
        Some(predicted) => predicted.results(),
        None => network.predict(&fused),
    };
    let image = (x0.clone() + 1.0) * 0.5;
    let mut sum = WeightedSum::default();
    sum.add(
        "prediction",
        weights.prediction,
        match weights.form {
            LossForm::L2Tv => reconstruction(image.clone(), truth.clone()),
            LossForm::Edm => {
                let error = x0 - (truth.clone() * 2.0 - 1.0);
                (error / scale.clamp_min(MIN_SCALE)).powi_scalar(2).mean()
            }
        },
    );
    sum.add(
        "pre",
        weights.pre,
        match weights.form {
            LossForm::L2Tv => reconstruction(d, truth.clone()),
            LossForm::Edm => {
                let unit = conditioning.noise_variance().sqrt() * USUAL_ERROR;
                relative_reconstruction(d, truth.clone(), unit)
            }
        },
    );
    if let Some(lpips) = perceptual {
        let later = after_the_start(example.timesteps);
        sum.add("perceptual", weights.perceptual, perceptual_loss(lpips, &image, example, &later));
    }
    let of_images = sum.total();
    // Where nothing moves, there is nothing to learn of it.
    let learns_flow = weights.flow > 0.0 && !network.ablation().removes(Part::Flow);
    let flow = learns_flow.then(|| flows.warping_error(truth, conditioning.frames));
    if let Some(flow) = &flow {
        sum.add("flow", weights.flow, flow.clone());
    }
    let recomputation = kept.zip(predicted).map(|(predenoised, predicted)| {
        let of_flows = flow.map(|flow| flow * weights.flow);
        Recomputation { predenoised, predicted, of_images, of_flows }
    });
    Ok(LossTerms { sum, recomputation })
}

/// Returns the samples at other timesteps than the last, whose predictions stay the posterior mean.
fn after_the_start(timesteps: &[usize]) -> Vec<usize> {
    (0..timesteps.len()).filter(|&n| timesteps[n] < NUM_TIMESTEPS - 1).collect()
}

/// Computes the perceptual distance of the predictions of some samples, `[1]`; zero of none.
///
/// # Shapes
/// - images: `[bursts * frames, 1, height, width]` in image units
pub(super) fn perceptual_loss(
    lpips: &Lpips,
    images: &Tensor<4>,
    example: &Example<'_>,
    samples: &[usize],
) -> Tensor<1> {
    if samples.is_empty() {
        return images.clone().mean() * 0.0;
    }
    let frames = example.conditioning.frames;
    let only = |images: &Tensor<4>| {
        let burst = |&number: &usize| images.clone().narrow(0, number * frames, frames);
        Tensor::cat(samples.iter().map(burst).collect(), 0)
    };
    lpips.loss(only(images), only(&example.truth))
}
