//! Drawing all bursts of a recipe before anything learns from them.

use super::{BurstSampler, Files};
use crate::dataset::Dataset;
use crate::learner::Learner;
use crate::recipe::Recipe;
use burn::tensor::Device;
use qudi_core::{Error, Result};
use std::ops::ControlFlow;

/// Draws the bursts of a recipe with `train.crops` that its folder lacks, aligned by `network`, on `workers`
/// threads. `on` hears how many there are and how many there will be, and says
/// whether to go on.
///
/// # Errors
/// [`Error`] if `files` name no folder for bursts, the data or the disk fail, or bursts of something else lie
/// in the folder; [`Error::Interrupted`] if asked to stop.
pub fn draw_bursts<L: Learner>(
    recipe: &Recipe,
    network: &L,
    files: Files,
    device: &Device,
    workers: usize,
    on: &mut dyn FnMut([u64; 2]) -> ControlFlow<()>,
) -> Result<()> {
    let Some(folder) = &files.bursts else {
        return Err(Error::request("no folder for bursts", "bursts", "name one"));
    };
    let dataset = Dataset::new(&recipe.data, files.pack)?;
    let aligner = network.aligner(recipe, device)?;
    let bursts = BurstSampler::new(recipe, dataset, aligner).with_cache(folder, recipe)?;
    bursts.draw_all(workers, on)
}
