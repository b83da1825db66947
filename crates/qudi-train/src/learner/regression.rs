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
use qudi_model::config::NetworkConfig;
use qudi_model::regression::{BurstAligner, Refinement, Regression, RegressionRestorer};
use std::path::Path;

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

    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        load_fitting(path, &NetworkConfig::Regression(recipe.network.regression()?.clone()), device)
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<AlignedBatch> {
        AlignedBatch::draw(recipe, bursts, number)
    }

    fn loss<'a>(&'a self, batch: &'a AlignedBatch, context: &Context<'a>) -> Result<Loss<'a>> {
        let aligned = batch.aligned.to_tensors(batch.size, context.device);
        let truth = to_tensor(batch.truth.clone(), batch.size, context.device);
        let (frames, sigma) = if context.recipe.trains_refinement() {
            (self.refinement().predenoise(&aligned), None)
        } else {
            let (frames, sigma) = self.predenoise(&aligned);
            (frames, Some(sigma))
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
        Ok(Box::new(RegressionRestorer::new(model, TILE, ComputePrecision::F32, device)?))
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
            BurstAligner::second(config, Refinement::new(self, config, TILE, device))
        }))
    }
}
