//! Samples of learned baselines: counts, the truth in their units, and static frames.

use crate::burst_cache::BurstSampler;
use crate::burst_cache::burst::ConditionedBurst;
use crate::dataset::Sample;
use crate::recipe::Recipe;
use burn::tensor::Device;
use qudi_baselines::learning::{Baseline, Bursts};
use qudi_baselines::restorer::ExpectedCounts;
use qudi_core::{Camera, Light, Result, Size};
use qudi_layers::tensor::to_tensor;

/// Changes the seed of static frames, so that their photons differ from the photons of the moving scene.
const STILL: u64 = 0x5EED_0057_1177;

/// The samples of one pass, values over full scale.
#[derive(Clone, Debug)]
pub struct CountBatch {
    size: Size,
    frames: usize,
    counts: Vec<f32>,
    truth: Vec<f32>,
    still: Option<Vec<f32>>,
}

impl CountBatch {
    /// Draws batch `number` of a recipe.
    ///
    /// # Errors
    /// [`qudi_core::Error`] if the data cannot be read, or the recipe is for another network.
    pub(super) fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Self> {
        let count = recipe.train.batch as u64;
        let (frames, side) = recipe.sample_size();
        let size = Size { height: side, width: side };
        let has_still = Baseline::needs_still_frames(recipe.network.baseline()?);
        let mut batch = Self {
            size,
            frames,
            counts: Vec::new(),
            truth: Vec::new(),
            still: has_still.then(Vec::new),
        };
        for sample in number * count..(number + 1) * count {
            let ConditionedBurst { sample, .. } = bursts.sample(sample)?;
            let full = f32::from(sample.acquisition.sensor.max_count());
            let over_full = |counts: &Vec<u16>| -> Vec<f32> {
                counts.iter().map(|&count| f32::from(count) / full).collect()
            };
            batch.counts.extend(sample.counts.iter().flat_map(over_full));
            let expected = ExpectedCounts::of(&sample.acquisition);
            let truth = sample.truth.iter().flat_map(|frame| &frame.data);
            batch.truth.extend(truth.map(|&value| expected.target(value)));
            if let Some(still) = &mut batch.still {
                still.extend(held_still(&sample)?.iter().flat_map(over_full));
            }
        }
        Ok(batch)
    }

    /// Copies the batch to `device`.
    pub(super) fn on(&self, device: &Device) -> Bursts {
        let tensor = |values: &Vec<f32>| to_tensor(values.clone(), self.size, device);
        Bursts {
            counts: tensor(&self.counts),
            truth: tensor(&self.truth),
            still: self.still.as_ref().map(tensor),
            frames: self.frames,
        }
    }
}

/// Counts of the frame that is restored, as if the scene stood still, with photons of their own.
fn held_still(sample: &Sample) -> Result<Vec<Vec<u16>>> {
    let acquisition = &sample.acquisition;
    let light = Light { ppp: acquisition.ppp, mean_level: acquisition.mean_level };
    let scene = &sample.truth[sample.truth.len() / 2];
    let seed = acquisition.seed ^ STILL;
    let mut camera = Camera::new(&acquisition.sensor, scene.size, light, seed)?;
    (0..sample.truth.len() as u64).map(|t| camera.expose(t, &[scene])).collect()
}
