//! Restoring by diffusion: reverse steps from noise, with the sensor's forward model between them.

use super::{Model, SampleOptions};
use crate::checkpoint::ModelKind;
use crate::conditioning::{AlignedPlanes, Conditioning, CountPlanes, sensor_tensor};
use crate::config::{NetworkConfig, Part, ReferenceKind};
use crate::diffusion::forward_model::ForwardModel;
use crate::diffusion::noise::Noise;
use crate::diffusion::sampler::{Step, sample};
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use crate::network::{Encoded, Flows, Qudi, Simulated};
use crate::refinement::{RefinementStage, align};
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored};
use qudi_layers::Tiling;
use qudi_layers::tensor::{read, to_tensor};

/// Restores windows by sampling.
#[derive(Debug)]
pub struct DiffusionRestorer {
    network: Qudi,
    stages: Vec<RefinementStage>,
    config: NetworkConfig,
    /// Whether frames are pre-denoised once, for no simulated measurement changes them.
    predenoises_once: bool,
    schedule: NoiseSchedule,
    options: SampleOptions,
    device: Device,
    window: usize,
}

/// A window, padded.
struct Window<'a> {
    acquisition: &'a Acquisition,
    sensor: Tensor<2>,
    counts: CountPlanes,
    /// None without a reference estimate, and once the only tile is encoded.
    aligned: Option<AlignedPlanes>,
    frames: usize,
    tiling: Tiling,
    /// The encoded tile, kept for all steps where there is only one: it takes memory.
    encoded: Option<Encoded>,
}

impl DiffusionRestorer {
    pub(super) fn new(model: Model, options: SampleOptions, device: &Device) -> Self {
        let Model { network, config, kind, window } = model;
        let stages = RefinementStage::all(&network, &config, options.tile, device);
        Self {
            network,
            stages,
            config,
            predenoises_once: kind == ModelKind::DiffusionAfterRegression,
            schedule: NoiseSchedule::cosine(NUM_TIMESTEPS),
            options,
            device: device.clone(),
            window,
        }
    }

    pub(super) fn window(&self) -> usize {
        self.window
    }

    pub(super) fn restore(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
    ) -> Result<Restored> {
        let window = self.window_of(burst, acquisition)?;
        let mut moments = Moments::default();
        for number in 0..self.options.samples as u64 {
            moments.add(&self.sample(&window, number)?);
        }
        let tiling = &window.tiling;
        Ok(Restored {
            frames: tiling.frames(&moments.mean()),
            std: (self.options.samples > 1).then(|| tiling.frames(&moments.standard_deviation())),
        })
    }

    /// Aligns a window and pads its planes to the size that the network needs.
    fn window_of<'a>(
        &self,
        burst: BurstView<'_>,
        acquisition: &'a Acquisition,
    ) -> Result<Window<'a>> {
        let frames = burst.frames.len();
        let tiling = Tiling::new(burst.size, self.config.multiple(), self.options.tile);
        let aligned = match self.config.reference {
            ReferenceKind::None => None,
            ReferenceKind::QbpRefined => {
                let neighbours = self.config.pre.aligned_neighbours();
                let aligned = align(burst, acquisition, &self.stages)?;
                let planes = AlignedPlanes::new(&aligned, neighbours, 0..frames);
                Some(planes.map(|plane| tiling.padded(plane)))
            }
        };
        let mut window = Window {
            acquisition,
            sensor: sensor_tensor(acquisition, &self.device),
            counts: CountPlanes::new(burst, acquisition).map(|plane| tiling.padded(plane)),
            aligned,
            frames,
            tiling,
            encoded: None,
        };
        if window.tiling.tiles.count() == 1 {
            let aligned = window.aligned.take();
            window.encoded = Some(self.encode(&window, 0, aligned));
        }
        Ok(window)
    }

    /// One sample of a window, padded, in [-1, 1].
    fn sample(&self, window: &Window<'_>, number: u64) -> Result<Vec<f32>> {
        let noise = Noise::new(window.acquisition.seed, number);
        let pixels = window.tiling.size.pixels();
        let noise_of = |step: usize| -> Vec<f32> {
            let frames = (window.acquisition.first_frame..).take(window.frames);
            frames.flat_map(|frame| noise.frame(frame, step, pixels)).collect()
        };
        let tiles = &window.tiling.tiles;
        let mut flows: Vec<Option<Flows>> = vec![None; tiles.count()];
        let SampleOptions { sampler, steps, spacing, .. } = self.options;
        let steps = sampler.steps(&self.schedule, steps, spacing);
        let count = steps.len();
        let predict = |step: &Step, x: &[f32], x0: &[f32]| {
            progress("diffusing", step.number, count)?;
            let simulated = self.simulated(window, step, x0, noise.photon_seed(step.number))?;
            if self.config.flow.steps.contains(&step.number) {
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

    /// The previous estimate `x0` as the forward model measures it; none at the first step.
    fn simulated(
        &self,
        window: &Window<'_>,
        step: &Step,
        x0: &[f32],
        seed: u64,
    ) -> Result<Option<CountPlanes>> {
        if step.number == 1 || self.config.ablates(Part::ForwardModel) {
            return Ok(None);
        }
        let acquisition = window.acquisition;
        let model = ForwardModel::new(acquisition, step.timestep);
        let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
        model.measure(&images, window.tiling.size, acquisition.first_frame, seed).map(Some)
    }

    /// The network's clean image of tile `number`, in [-1, 1], from the noisy image and the previous
    /// estimate.
    fn predict(
        &self,
        window: &Window<'_>,
        number: usize,
        simulated: Option<&CountPlanes>,
        [x, x0]: [&[f32]; 2],
        step: &Step,
        flows: &mut Option<Flows>,
    ) -> Result<Vec<f32>> {
        let tensor = |images: &[f32]| self.tile(window, number, images);
        let fresh;
        let encoded = if let Some(encoded) = &window.encoded {
            encoded
        } else {
            let crop = |plane: &[f32]| window.tiling.tiles.crop(number, plane);
            let aligned = window.aligned.as_ref().map(|planes| planes.map(crop));
            fresh = self.encode(window, number, aligned);
            &fresh
        };
        let simulated = simulated.map(|planes| Simulated {
            y: tensor(&planes.y),
            u: tensor(&planes.u),
            exists: vec![true],
        });
        let has_previous = step.number > 1 && !self.config.ablates(Part::SelfConditioning);
        let state = DiffusionState {
            x_t: tensor(x),
            x0_prev: tensor(x0),
            has_previous: vec![has_previous],
            timesteps: vec![step.timestep],
        };
        let prediction = self.network.forward(encoded, simulated.as_ref(), &state, flows.take());
        *flows = Some(prediction.flows);
        let image = read(prediction.x0)?;
        Ok(image.into_iter().map(|value| value.clamp(-1.0, 1.0)).collect())
    }

    /// Tile `number` of images of the whole frame.
    fn tile(&self, window: &Window<'_>, number: usize, images: &[f32]) -> Tensor<4> {
        let tiles = &window.tiling.tiles;
        to_tensor(tiles.crop(number, images), tiles.tile, &self.device)
    }

    /// Encodes what does not depend on the step, of tile `number`, whose planes are `aligned`.
    fn encode(
        &self,
        window: &Window<'_>,
        number: usize,
        aligned: Option<AlignedPlanes>,
    ) -> Encoded {
        let size = window.tiling.tiles.tile;
        let encoded = self.network.encode(&Conditioning {
            counts: self.tile(window, number, &window.counts.y),
            linear_estimate: self.tile(window, number, &window.counts.u),
            aligned: aligned.map(|planes| planes.into_tensors(size, &self.device)),
            sensor: window.sensor.clone(),
            frames: window.frames,
        });
        if self.predenoises_once { self.network.predenoise_once(encoded) } else { encoded }
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
