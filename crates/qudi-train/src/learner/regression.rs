//! The regression as it learns: first the refinement, then the second pre-denoiser with the uncertainty.

use super::{Context, Learner, Loss, Origin, WeightedSum, learning, load_fitting, save_described};
use crate::burst_cache::BurstSampler;
use crate::burst_cache::burst::ConditionedBurst;
use crate::loss::{gaussian_nll, relative_reconstruction, root_mean_square};
use crate::parameters::gradients;
use crate::recipe::Recipe;
use burn::tensor::Device;
use qudi_core::restorer::Restorer;
use qudi_core::{Result, Size};
use qudi_kernels::ComputePrecision;
use qudi_layers::TILE;
use qudi_layers::tensor::to_tensor;
use qudi_model::aligned::Aligned;
use qudi_model::checkpoint::{Description, describe, load};
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::{DiffusionRestorer, SampleOptions};
use qudi_model::regression::{
    AlignmentFrames, BurstAligner, FirstFrames, Regression, RegressionConfig, RegressionRestorer,
};
use qudi_model::restorer::Model;
use qudi_model::window::Window;
use std::path::Path;
use std::sync::Arc;

/// The samples of one pass.
#[derive(Clone, Debug)]
pub struct AlignedBatch {
    size: Size,
    frames: usize,
    aligned: Aligned<Vec<f32>>,
    truth: Vec<f32>,
}

impl AlignedBatch {
    /// Draws batch `number` of a recipe.
    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Self> {
        let count = recipe.train.batch as u64;
        let (frames, side) = recipe.sample_size();
        let size = Size { height: side, width: side };
        let mut batch = Self { size, frames, aligned: Aligned::default(), truth: Vec::new() };
        for number in number * count..(number + 1) * count {
            let ConditionedBurst { sample, aligned, .. } = bursts.sample(number)?;
            batch.aligned.extend(aligned.expect("a sampler that aligns"));
            batch.truth.extend(sample.truth.into_iter().flat_map(|frame| frame.data));
        }
        Ok(batch)
    }
}

impl Learner for Regression {
    type Batch = AlignedBatch;

    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.regression()?.uninitialized(device))
    }

    fn init(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.regression()?.init(recipe.train.seed, device))
    }

    /// Loads weights of the recipe's network. A correction of a diffusion can also start from a whole
    /// regression, whose first pre-denoiser it leaves out.
    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        let config = recipe.network.regression()?;
        let whole = RegressionConfig { first: FirstFrames::Refinement, ..config.clone() };
        let is_whole = describe(path)?.network == NetworkConfig::Regression(whole.clone());
        if is_whole && *config != whole {
            let (network, _) = load::<Self>(path, device)?;
            return Ok(network.without_refinement());
        }
        load_fitting(path, &NetworkConfig::Regression(config.clone()), device)
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<AlignedBatch> {
        AlignedBatch::draw(recipe, bursts, number)
    }

    fn loss<'a>(&'a self, batch: &'a AlignedBatch, context: &Context<'a>) -> Result<Loss<'a>> {
        let aligned = batch.aligned.to_tensors(batch.size, context.device);
        let truth = to_tensor(batch.truth.clone(), batch.size, context.device);
        let (frames, sigma) = match self.refinement() {
            Some(refinement) if context.recipe.trains_refinement() => {
                (refinement.predenoise(&aligned), None)
            }
            _ => {
                let (frames, sigma) = self.predenoise(&aligned);
                (frames, Some(sigma))
            }
        };
        let mut sum = WeightedSum::default();
        // One where the error is the reference estimate's.
        let unit = root_mean_square(aligned.reference - truth.clone(), batch.frames);
        sum.add("pre", 1.0, relative_reconstruction(frames.clone(), truth.clone(), unit));
        if let Some(sigma) = sigma {
            sum.add("uncertainty", 1.0, gaussian_nll(frames.detach() - truth, sigma));
        }
        let total = sum.total();
        Ok(Loss {
            total: total.clone(),
            terms: sum.terms,
            gradients: Box::new(move || gradients(self, &total.backward())),
            statistics: Vec::new(),
        })
    }

    /// Creates the restorer of the whole network. While the refinement learns, the second pre-denoiser
    /// changes nothing: its last layer is zero.
    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>> {
        let config = recipe.network.regression()?.clone();
        let model = recipe.model(self.clone(), config);
        let diffusion = diffusion(recipe, device)?;
        let precision = ComputePrecision::F32;
        Ok(Box::new(RegressionRestorer::new(model, diffusion, TILE, precision, device)?))
    }

    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()> {
        let sizes = NetworkConfig::Regression(recipe.network.regression()?.clone());
        save_described(self, sizes, None, recipe, origin, path)
    }

    fn learns(&self, recipe: &Recipe) -> Vec<bool> {
        learning(self, recipe)
    }

    fn aligner(&self, recipe: &Recipe, device: &Device) -> Result<Option<BurstAligner>> {
        let config = recipe.network.regression()?;
        Ok(Some(if recipe.trains_refinement() {
            BurstAligner::first(config)
        } else {
            let diffusion = diffusion(recipe, device)?;
            let frames = AlignmentFrames::new(self, config, diffusion, TILE, device)?;
            BurstAligner::second(config, frames)
        }))
    }
}

/// Loads the window network whose frames are corrected; none where the recipe names none.
fn diffusion(recipe: &Recipe, device: &Device) -> Result<Option<Arc<DiffusionRestorer<Window>>>> {
    let Some(path) = &recipe.train.first else { return Ok(None) };
    let (network, description) = load::<Window>(Path::new(path), device)?;
    let Description { network: NetworkConfig::Window(config), window, passes, .. } = description
    else {
        unreachable!("a window network has sizes of one")
    };
    let model = Model { network, config, window, passes };
    let restorer = DiffusionRestorer::new(model, SampleOptions::default(), device)?;
    Ok(Some(Arc::new(restorer)))
}
