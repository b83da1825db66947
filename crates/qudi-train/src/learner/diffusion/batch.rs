//! Samples as planes, noise and times, ready to go to a device.

use super::Example;
use crate::burst_cache::BurstSampler;
use crate::burst_cache::burst::ConditionedBurst;
use crate::recipe::Recipe;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::{Result, Size};
use qudi_layers::tensor::to_tensor;
use qudi_model::counts::CountPlanes;
use qudi_model::diffusion::noise::Noise;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{BurstMotion, Conditioning};
use qudi_model::sensor::{RESPONSE_LEVELS, SENSOR_NUMBERS, response_levels, sensor_numbers};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::sync::Arc;

/// The samples of one pass of the diffusion.
#[derive(Clone, Debug)]
pub struct Batch {
    /// The number of the batch in its run.
    pub number: u64,
    size: Size,
    frames: usize,
    counts: CountPlanes,
    truth: Vec<f32>,
    noise: Vec<f32>,
    numbers: Vec<f32>,
    acquisitions: Vec<Acquisition>,
    /// Finders of the motion in the counts; none where the network learns to follow its own flow.
    motion: Vec<Arc<BurstMotion>>,
    timesteps: Vec<usize>,
    /// Timesteps of the batch that this is a part of; the same for a whole batch.
    timesteps_of_all: Vec<usize>,
    uploaded: Option<Box<Uploaded>>,
}

/// The planes of a batch on the device that computes with them.
#[derive(Clone, Debug)]
struct Uploaded {
    conditioning: Conditioning,
    truth: Tensor<4>,
    noise: Tensor<4>,
}

impl Batch {
    /// Draws batch `number` of a recipe.
    ///
    /// # Errors
    /// [`qudi_core::Error`] if the data cannot be read.
    pub fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Self> {
        let count = recipe.train.batch;
        let (frames, side) = recipe.sample_size();
        let size = Size { height: side, width: side };
        let mut batch = Self {
            number,
            size,
            frames,
            counts: CountPlanes::default(),
            truth: Vec::new(),
            noise: Vec::new(),
            numbers: Vec::new(),
            acquisitions: Vec::new(),
            motion: Vec::new(),
            timesteps: Vec::new(),
            timesteps_of_all: Vec::new(),
            uploaded: None,
        };
        let matched = recipe.train.matches(number);
        for sample in (number * count as u64..).take(count) {
            let ConditionedBurst { sample: drawn, .. } = bursts.sample(sample)?;
            let view = BurstView { size, frames: &drawn.counts };
            if matched {
                batch.motion.push(Arc::new(BurstMotion::new(view, &drawn.acquisition)));
            }
            batch.counts.extend(CountPlanes::new(view, &drawn.acquisition));
            batch.truth.extend(drawn.truth.into_iter().flat_map(|frame| frame.data));
            let noise = Noise::new(drawn.acquisition.seed, 0);
            let noise = (0..frames as u64).flat_map(|frame| noise.frame(frame, 0, size.pixels()));
            batch.noise.extend(noise);
            batch.numbers.extend(sensor_numbers(&drawn.acquisition));
            let mut random = ChaCha8Rng::seed_from_u64(drawn.acquisition.seed);
            let timesteps = recipe.train.timesteps;
            let at_start = random.random::<f64>() < recipe.train.noise_start_fraction();
            let quantile = random.random();
            let timestep = timesteps.timestep(quantile);
            batch.timesteps.push(if at_start { NUM_TIMESTEPS - 1 } else { timestep });
            batch.acquisitions.push(drawn.acquisition);
        }
        batch.timesteps_of_all.clone_from(&batch.timesteps);
        Ok(batch)
    }

    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.acquisitions.len()
    }

    /// Returns true if there are no samples.
    pub fn is_empty(&self) -> bool {
        self.acquisitions.is_empty()
    }

    /// Splits the batch into at most `count` parts with as many samples each.
    pub(in crate::learner) fn parts(self, count: usize) -> Vec<Self> {
        let all = self.len();
        let count = (1..=count.min(all)).rev().find(|&n| all.is_multiple_of(n)).unwrap_or(1);
        if count == 1 {
            return vec![self];
        }
        let samples = all / count;
        let part = |number: usize| {
            let first = number * samples;
            let planes = |values: &[f32]| share(values, number, count).to_vec();
            Self {
                number: self.number,
                size: self.size,
                frames: self.frames,
                counts: self.counts.map(planes),
                truth: planes(&self.truth),
                noise: planes(&self.noise),
                numbers: planes(&self.numbers),
                motion: self.motion.iter().skip(first).take(samples).cloned().collect(),
                acquisitions: self.acquisitions[first..first + samples].to_vec(),
                timesteps: self.timesteps[first..first + samples].to_vec(),
                timesteps_of_all: self.timesteps_of_all.clone(),
                uploaded: None,
            }
        };
        (0..count).map(part).collect()
    }

    /// Returns the timesteps of the batch that this is a part of.
    pub(in crate::learner) fn timesteps_of_all(&self) -> &[usize] {
        &self.timesteps_of_all
    }

    /// Returns the factor of a mean over `count` samples of this part that makes the mean over parts the mean
    /// over the `of_batch` samples of the batch: 1 for a whole batch.
    pub(in crate::learner) fn share(&self, count: usize, of_batch: usize) -> f32 {
        let parts = self.timesteps_of_all.len() as f32 / self.timesteps.len() as f32;
        parts * count as f32 / of_batch.max(1) as f32
    }

    /// Copies the batch to `device` ahead of its use.
    pub(in crate::learner) fn upload(&mut self, device: &Device) {
        let conditioning = self.conditioning(device);
        let Example { truth, noise, .. } = self.example(&conditioning);
        self.uploaded = Some(Box::new(Uploaded { conditioning, truth, noise }));
    }

    /// Returns the conditioning of the batch on `device`.
    pub(in crate::learner) fn conditioning(&self, device: &Device) -> Conditioning {
        if let Some(uploaded) = self.uploaded_to(device) {
            return uploaded.conditioning.clone();
        }
        let numbers = TensorData::new(self.numbers.clone(), [self.len(), SENSOR_NUMBERS]);
        let levels = self.acquisitions.iter().flat_map(response_levels).collect();
        let response = TensorData::new::<f32, _>(levels, [self.len(), RESPONSE_LEVELS]);
        Conditioning {
            counts: to_tensor(self.counts.y.clone(), self.size, device),
            linear_estimate: to_tensor(self.counts.u.clone(), self.size, device),
            sensor: Tensor::from_data(numbers, device),
            response: Tensor::from_data(response, device),
            frames: self.frames,
            motion: self.motion.clone(),
        }
    }

    fn uploaded_to(&self, device: &Device) -> Option<&Uploaded> {
        self.uploaded.as_deref().filter(|uploaded| uploaded.truth.device() == *device)
    }

    /// Returns the batch as an example for the loss, on the device of `conditioning`.
    pub(in crate::learner) fn example<'a>(&'a self, conditioning: &'a Conditioning) -> Example<'a> {
        let device = conditioning.linear_estimate.device();
        let (truth, noise) = if let Some(uploaded) = self.uploaded_to(&device) {
            (uploaded.truth.clone(), uploaded.noise.clone())
        } else {
            let tensor = |values: &Vec<f32>| to_tensor(values.clone(), self.size, &device);
            (tensor(&self.truth), tensor(&self.noise))
        };
        Example {
            conditioning,
            truth,
            acquisitions: &self.acquisitions,
            noise,
            timesteps: &self.timesteps,
        }
    }
}

/// Returns part `number` of `count` equal parts.
fn share(values: &[f32], number: usize, count: usize) -> &[f32] {
    let length = values.len() / count;
    &values[number * length..(number + 1) * length]
}
