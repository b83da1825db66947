//! Restores windows by diffusion: reverse steps from noise, with the sensor's forward model between them.

use super::denoiser::Denoiser;
use super::forward_model::ForwardModel;
use super::network::Simulated;
use super::noise::Noise;
use super::sampler::{Sampler, Step, sample};
use super::schedule::NoiseSchedule;
use super::state::DiffusionState;
use super::timesteps::{NUM_TIMESTEPS, TimestepSpacing};
use super::{Conditioning, Part};
use crate::counts::CountPlanes;
use crate::restorer::{Model, check_frames, check_tile};
use crate::sensor::sensor_tensor;
use burn::tensor::{Device, Tensor};
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Result};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::tensor::{read, to_tensor};
use qudi_layers::{TILE, Tiling};

/// Options of sampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Reverse steps. One gives the mean of all pictures that fit; more give sharper ones.
    pub steps: usize,
    /// Spacing of their timesteps.
    pub spacing: TimestepSpacing,
    /// Sampler.
    pub sampler: Sampler,
    /// Samples drawn. Their mean is the result, their standard deviation its uncertainty.
    pub samples: usize,
    /// Side of the tiles that the network sees, in pixels.
    pub tile: usize,
    /// Numbers that convolutions multiply.
    pub precision: ComputePrecision,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self {
            steps: 1,
            spacing: TimestepSpacing::default(),
            sampler: Sampler::Ddim,
            samples: 1,
            tile: TILE,
            precision: ComputePrecision::F32,
        }
    }
}

/// Restores windows by sampling.
#[derive(Debug)]
pub struct DiffusionRestorer<N: Denoiser> {
    network: N,
    config: N::Config,
    schedule: NoiseSchedule,
    options: SampleOptions,
    device: Device,
    window: usize,
}

/// A window, padded.
struct Window<'a, E> {
    acquisition: &'a Acquisition,
    sensor: Tensor<2>,
    counts: CountPlanes,
    frames: usize,
    tiling: Tiling,
    /// The encoded tile, kept for all steps where there is only one: it takes memory.
    encoded: Option<E>,
}

impl<N: Denoiser> DiffusionRestorer<N> {
    /// Creates the restorer of a model whose weights are on `device`.
    ///
    /// # Errors
    /// [`Error::Request`] for options that make no sense.
    pub fn new(
        model: Model<N, N::Config>,
        options: SampleOptions,
        device: &Device,
    ) -> Result<Self> {
        if !(1..=NUM_TIMESTEPS).contains(&options.steps) {
            let what = format!("{} reverse steps", options.steps);
            return Err(Error::request(what, "steps", format!("use 1 to {NUM_TIMESTEPS}")));
        }
        if options.samples == 0 {
            return Err(Error::request("no samples at all", "samples", "draw at least 1"));
        }
        let Model { network, config, window } = model;
        check_tile(options.tile, N::multiple(&config))?;
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        Ok(Self { network, config, schedule, options, device: device.clone(), window })
    }

    fn restored(&self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let window = self.window_of(burst, acquisition);
        let mut moments = Moments::default();
        for number in 0..self.options.samples as u64 {
            moments.add(&self.sample(&window, number)?);
        }
        let tiling = &window.tiling;
        let drawn = self.options.samples > 1;
        let std = drawn.then(|| tiling.frames(&moments.standard_deviation()));
        Ok(Restored::gray(tiling.frames(&moments.mean()), std))
    }

    /// Pads a window to the size that the network needs.
    fn window_of<'a>(
        &self,
        burst: BurstView<'_>,
        acquisition: &'a Acquisition,
    ) -> Window<'a, N::Encoded> {
        let tiling = Tiling::new(burst.size, N::multiple(&self.config), self.options.tile);
        let mut window = Window {
            acquisition,
            sensor: sensor_tensor(acquisition, &self.device),
            counts: CountPlanes::new(burst, acquisition).map(|plane| tiling.padded(plane)),
            frames: burst.frames.len(),
            tiling,
            encoded: None,
        };
        if window.tiling.tiles.count() == 1 {
            window.encoded = Some(self.encode(&window, 0));
        }
        window
    }

    /// Draws one sample of a window, padded, in [-1, 1].
    fn sample(&self, window: &Window<'_, N::Encoded>, number: u64) -> Result<Vec<f32>> {
        let noise = Noise::new(window.acquisition.seed, number);
        let pixels = window.tiling.size.pixels();
        let noise_of = |step: usize| -> Vec<f32> {
            let frames = (window.acquisition.first_frame..).take(window.frames);
            frames.flat_map(|frame| noise.frame(frame, step, pixels)).collect()
        };
        let tiles = &window.tiling.tiles;
        let mut flows: Vec<Option<N::Flows>> = vec![None; tiles.count()];
        let SampleOptions { sampler, steps, spacing, .. } = self.options;
        let steps = sampler.steps(&self.schedule, steps, spacing);
        let count = steps.len();
        let predict = |step: &Step, x: &[f32], x0: &[f32]| {
            progress("diffusing", step.number, count)?;
            let simulated = self.simulated(window, step, x0, noise.photon_seed(step.number))?;
            if N::renews_flows(&self.config, step.number) {
                flows.fill(None);
            }
            let mut prediction = vec![0.0; x.len()];
            for (tile, flows) in flows.iter_mut().enumerate() {
                let part = self.predict(window, tile, simulated.as_ref(), [x, x0], step, flows)?;
                tiles.blend(tile, &part, &mut prediction);
            }
            Ok(prediction)
        };
        let fresh = |step: &Step| {
            let needed = if step.sigma > 0.0 { noise_of(step.number) } else { Vec::new() };
            needed.into_iter()
        };
        sample(&steps, noise_of(0), predict, fresh)
    }

    /// Measures the previous estimate `x0` with the forward model; none at the first step.
    fn simulated(
        &self,
        window: &Window<'_, N::Encoded>,
        step: &Step,
        x0: &[f32],
        seed: u64,
    ) -> Result<Option<CountPlanes>> {
        if step.number == 1 || !self.network.uses(Part::ForwardModel) {
            return Ok(None);
        }
        let acquisition = window.acquisition;
        let model = ForwardModel::new(acquisition, step.timestep);
        let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
        model.measure(&images, window.tiling.size, acquisition.first_frame, seed).map(Some)
    }

    /// Predicts the clean image of tile `number`, in [-1, 1], from the noisy image and the previous
    /// estimate.
    fn predict(
        &self,
        window: &Window<'_, N::Encoded>,
        number: usize,
        simulated: Option<&CountPlanes>,
        [x, x0]: [&[f32]; 2],
        step: &Step,
        flows: &mut Option<N::Flows>,
    ) -> Result<Vec<f32>> {
        let tensor = |images: &[f32]| self.tile(window, number, images);
        let fresh;
        let encoded = if let Some(encoded) = &window.encoded {
            encoded
        } else {
            fresh = self.encode(window, number);
            &fresh
        };
        let simulated = simulated.map(|planes| Simulated {
            y: tensor(&planes.y),
            u: tensor(&planes.u),
            exists: vec![true],
        });
        let has_previous = step.number > 1 && self.network.uses(Part::SelfConditioning);
        let state = DiffusionState {
            x_t: tensor(x),
            x0_prev: tensor(x0),
            has_previous: vec![has_previous],
            timesteps: vec![step.timestep],
        };
        let image = read(self.network.denoise(encoded, simulated.as_ref(), &state, flows))?;
        Ok(image.into_iter().map(|value| value.clamp(-1.0, 1.0)).collect())
    }

    /// Crops tile `number` of images of the whole frame.
    fn tile(&self, window: &Window<'_, N::Encoded>, number: usize, images: &[f32]) -> Tensor<4> {
        let tiles = &window.tiling.tiles;
        to_tensor(tiles.crop(number, images), tiles.tile, &self.device)
    }

    /// Encodes what does not depend on the step, of tile `number`.
    fn encode(&self, window: &Window<'_, N::Encoded>, number: usize) -> N::Encoded {
        self.network.encode(&Conditioning {
            counts: self.tile(window, number, &window.counts.y),
            linear_estimate: self.tile(window, number, &window.counts.u),
            sensor: window.sensor.clone(),
            frames: window.frames,
        })
    }
}

impl<N: Denoiser> Restorer for DiffusionRestorer<N> {
    fn name(&self) -> &'static str {
        "qudi-diffusion"
    }

    fn window(&self) -> usize {
        self.window
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        check_frames(burst.frames.len(), self.window)?;
        let restored =
            with_precision(self.options.precision, || self.restored(burst, acquisition))?;
        Ok(restored.only(numbers))
    }
}

/// Mean and standard deviation over samples, in image units.
#[derive(Debug, Default)]
struct Moments {
    count: f32,
    sum: Vec<f32>,
    squares: Vec<f32>,
}

impl Moments {
    fn add(&mut self, x0: &[f32]) {
        self.sum.resize(x0.len(), 0.0);
        self.squares.resize(x0.len(), 0.0);
        self.count += 1.0;
        for ((sum, square), x0) in self.sum.iter_mut().zip(&mut self.squares).zip(x0) {
            let image = (x0 + 1.0) * 0.5;
            *sum += image;
            *square += image * image;
        }
    }

    fn mean(&self) -> Vec<f32> {
        self.sum.iter().map(|sum| sum / self.count).collect()
    }

    fn standard_deviation(&self) -> Vec<f32> {
        let pairs = self.sum.iter().zip(&self.squares);
        let variance = pairs
            .map(|(sum, squares)| (squares - sum * sum / self.count) / (self.count - 1.0).max(1.0));
        variance.map(|variance| variance.max(0.0).sqrt()).collect()
    }
}
