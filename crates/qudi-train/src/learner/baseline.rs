//! The learned methods of others as they learn here.

use super::{Context, CountBatch, Learner, Loss, Origin, provenance};
use crate::burst_cache::BurstSampler;
use crate::parameters::gradients;
use crate::recipe::Recipe;
use burn::tensor::{Device, Tensor};
use qudi_baselines::import::load;
use qudi_baselines::learning::{Baseline, Losses};
use qudi_baselines::restorer::{Brightness, LearnedRestorer};
use qudi_baselines::weights::{Description, save};
use qudi_core::atomic_file::Overwrite;
use qudi_core::restorer::Restorer;
use qudi_core::{Error, Result};
use std::path::Path;

impl Learner for Baseline {
    type Batch = CountBatch;

    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(Self::uninitialized(recipe.network.baseline()?, device))
    }

    fn init(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(Self::init(recipe.network.baseline()?, recipe.train.seed, device))
    }

    /// Of the same network. A student's teachers, which files do not hold, start anew.
    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        let wanted = recipe.network.baseline()?;
        let loaded = load(path, wanted.method(), device)?;
        if loaded.sizes != wanted {
            return Err(Error::data(
                format!("these weights have {}, and the recipe {wanted}", loaded.sizes),
                path,
                "choose the recipe that they were trained with, or change its [network] table",
            ));
        }
        Ok(Self::trained(loaded.network, wanted, recipe.train.seed, device))
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<CountBatch> {
        CountBatch::draw(recipe, bursts, number)
    }

    fn loss<'a>(&'a self, batch: &'a CountBatch, context: &Context<'a>) -> Result<Loss<'a>> {
        let bursts = batch.on(context.device);
        let Losses { terms, statistics } =
            self.losses(&bursts, context.step, context.recipe.train.steps);
        let total = Tensor::cat(terms.iter().map(|(_, term)| term.clone()).collect(), 0).sum();
        let of_total = total.clone();
        Ok(Loss {
            total,
            terms,
            gradients: Box::new(move || gradients(self, &of_total.backward())),
            statistics,
        })
    }

    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>> {
        let (network, sizes) = (self.network().clone(), recipe.network.baseline()?);
        Ok(Box::new(LearnedRestorer::new(network, sizes, Brightness::OfCounts, device)))
    }

    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()> {
        let description = Description {
            method: recipe.network.baseline()?.method().name().to_owned(),
            frames: recipe.sample_size().0,
            provenance: provenance(recipe, origin),
        };
        save(self.network(), &description, path, Overwrite::Yes)
    }

    fn named_shapes(&self) -> Vec<(String, Vec<usize>)> {
        self.parameter_shapes()
    }
}
