//! Quanta Diffusion as a method: windows of counts in, clean frames and their deviation out.

pub(crate) mod layout;
pub mod tiles;

use crate::config::{NetworkConfig, Part};
use crate::diffusion::noise::Noise;
use crate::diffusion::physics::LoopSensor;
use crate::diffusion::sampler::{Sampler, Step, TIMES};
use crate::diffusion::schedule::{NoiseSchedule, Spacing};
use crate::draft::{Denoised, Draft, denoised, settled};
use crate::measurement::{GuidePlanes, Planes, aligned, sensor_numbers};
use crate::network::{Flows, Measured, Prepared, Qudi, SENSOR_NUMBERS, Simulated, State};
use crate::restorer::layout::Layout;
use crate::tensor::{read, to_tensor};
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Result, SimError};

/// Fewest frames that the fusion makes sense of.
pub const FEWEST_FRAMES: usize = 3;

/// Largest deviation that a value in [0, 1] can have (Popoviciu 1935).
const MOST_ERROR: f32 = 0.5;

/// Usual side of the tiles that networks see, in pixels.
pub const TILE: usize = 512;

/// How to sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Reverse steps: 0 is no diffusion but the pre-denoised frames, steadied; 1 the mean of all pictures that fit; more are
    /// sharper.
    pub steps: usize,
    /// How their times lie.
    pub spacing: Spacing,
    /// How noise leaves.
    pub sampler: Sampler,
    /// Pictures drawn; their mean is the result, their deviation its uncertainty.
    pub samples: usize,
    /// Side of the tiles that the network sees, in pixels.
    pub tile: usize,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self {
            steps: 1,
            spacing: Spacing::default(),
            sampler: Sampler::Ddim,
            samples: 1,
            tile: TILE,
        }
    }
}

/// The network with everything that restoring needs.
#[derive(Debug)]
pub struct QudiRestorer {
    network: Qudi,
    drafts: Vec<Draft>,
    /// Whether its U-Net says anything, and is asked.
    generates: bool,
    /// Whether its pre-denoiser looks at simulated measurements.
    denoises_anew: bool,
    config: NetworkConfig,
    schedule: NoiseSchedule,
    options: SampleOptions,
    device: Device,
    window: usize,
}

impl QudiRestorer {
    /// A restorer of windows of `window` frames on `device`, which is where the weights of the network of sizes
    /// `config` are.
    ///
    /// # Errors
    /// [`SimError::Request`] for options that make no sense.
    pub fn new(
        network: Qudi,
        config: &NetworkConfig,
        window: usize,
        options: SampleOptions,
        device: &Device,
    ) -> Result<Self> {
        if options.steps > TIMES {
            let what = format!("{} reverse steps", options.steps);
            return Err(SimError::request(what, "--steps", format!("use 0 to {TIMES}")));
        }
        if options.samples == 0 {
            return Err(SimError::request("no samples at all", "--samples", "draw at least 1"));
        }
        let learnt = network.generates()?;
        if options.samples > 1 && !learnt {
            return Err(SimError::request(
                "these weights make the same picture of any noise: samples would not differ",
                "--samples",
                "leave it out, or use weights that learnt with train.loss.prediction above 0 (docs/training.md)",
            ));
        }
        let generates = learnt && options.steps > 0;
        if options.samples > 1 && !generates {
            let what = "samples do not differ where nothing is diffused";
            return Err(SimError::request(what, "--samples", "take some, as --steps 10"));
        }
        let smallest = 4 * config.multiple();
        if options.tile < smallest {
            let what = format!("tiles of {} pixels", options.tile);
            let help = format!("this network needs at least {smallest}");
            return Err(SimError::request(what, "--tile", help));
        }
        let denoises_anew = network.denoises_anew()?;
        let schedule = NoiseSchedule::cosine(TIMES);
        let drafts = Draft::all(&network, config, options.tile, device);
        let (config, device) = (config.clone(), device.clone());
        Ok(Self {
            network,
            drafts,
            generates,
            denoises_anew,
            config,
            schedule,
            options,
            device,
            window,
        })
    }

    /// A window whose planes are padded to what the network wants.
    fn job<'a>(&self, burst: BurstView<'_>, acquisition: &'a Acquisition) -> Result<Job<'a>> {
        let frames = burst.frames.len();
        let layout = Layout::new(burst.size, self.config.multiple(), self.options.tile);
        let planes = Planes::of(burst, acquisition);
        let planes = Planes { y: layout.padded(&planes.y), u: layout.padded(&planes.u) };
        let laid = self.config.pre.laid();
        let alignment = aligned(burst, acquisition, &self.drafts)?;
        let guide = GuidePlanes::of(&alignment, laid, 0..frames);
        let guide = guide.map(|plane| layout.padded(plane));
        let sensor = sensor_numbers(acquisition);
        let prepared = None;
        let mut job = Job { acquisition, sensor, planes, guide, frames, layout, prepared };
        if self.generates && job.layout.tiles.count() == 1 {
            // The one tile is all there is: nobody asks for its guide again.
            let guide = std::mem::take(&mut job.guide);
            job.prepared = Some(self.prepare(&job, 0, guide));
        }
        Ok(job)
    }

    /// One sample of a window whose planes are padded to `size`.
    fn sample(&self, job: &Job<'_>, sample: u64) -> Result<Vec<f32>> {
        let noise = Noise::new(job.acquisition.seed, sample);
        let frames = || (job.acquisition.first_frame..).take(job.frames);
        let (size, tiles) = (job.layout.size, &job.layout.tiles);
        let pixels = size.pixels();
        let mut x: Vec<f32> = frames().flat_map(|frame| noise.frame(frame, 0, pixels)).collect();
        let mut x0 = vec![0.0; x.len()];
        let mut flows: Vec<Option<Flows>> = vec![None; tiles.count()];
        let SampleOptions { sampler, steps, spacing, .. } = self.options;
        for step in sampler.steps(&self.schedule, steps, spacing) {
            let simulated = if step.number == 1 || self.config.lacks(Part::Physics) {
                None
            } else {
                let sensor = LoopSensor::at(job.acquisition, step.time, TIMES);
                let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
                let seed = noise.photon_seed(step.number);
                Some(sensor.measure(&images, size, job.acquisition.first_frame, seed)?)
            };
            if self.config.flow.steps.contains(&step.number) {
                flows.fill(None);
            }
            let mut next = vec![0.0; x.len()];
            for (number, flows) in flows.iter_mut().enumerate() {
                let images = [&x, &x0].map(Vec::as_slice);
                let tile = self.predict(job, number, simulated.as_ref(), images, &step, flows)?;
                tiles.blend(number, &tile, &mut next);
            }
            x0 = next;
            let fresh = frames().flat_map(|frame| noise.frame(frame, step.number, pixels));
            step.advance(&mut x, &x0, fresh);
        }
        Ok(x0)
    }

    /// What the pre-denoiser makes of the frames, without what the U-Net would take: most of the time and memory. Before any
    /// simulated measurement: where the U-Net has not learnt, none was seen in training. Fusion has no part in it: the frames,
    /// each denoised for itself, are steadied afterwards.
    fn denoised(&self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let laid = self.config.pre.laid();
        let alignment = aligned(burst, acquisition, &self.drafts)?;
        let layout = Layout::new(burst.size, self.config.multiple(), self.options.tile);
        let denoise = |guide: &Tensor<4>| {
            let (d, error) = self.network.denoise(guide);
            std::iter::once(d).chain(error).collect()
        };
        let Denoised { frames, mut errors, noises } =
            denoised(&alignment, laid, &layout, &self.device, denoise)?;
        for error in errors.iter_mut().flat_map(|frame| &mut frame.data) {
            *error = error.min(MOST_ERROR);
        }
        let frames = settled(&alignment, frames, noises, 1.0);
        Ok(Restored { frames, std: (!errors.is_empty()).then_some(errors) })
    }

    /// The network's clean image of one tile, in [-1, 1], from the noisy images and the estimate before.
    fn predict(
        &self,
        job: &Job<'_>,
        number: usize,
        simulated: Option<&Planes>,
        [x, x0]: [&[f32]; 2],
        step: &Step,
        flows: &mut Option<Flows>,
    ) -> Result<Vec<f32>> {
        let tensor = |images: &[f32]| self.tile(job, number, images);
        let fresh;
        let prepared = if let Some(prepared) = &job.prepared {
            prepared
        } else {
            let guide = job.guide.map(|images| job.layout.tiles.crop(number, images));
            fresh = self.prepare(job, number, guide);
            &fresh
        };
        let simulated = simulated.map(|planes| Simulated {
            y: tensor(&planes.y),
            u: tensor(&planes.u),
            exists: vec![true],
        });
        let known = step.number > 1 && !self.config.lacks(Part::SelfConditioning);
        let state = State {
            x_t: tensor(x),
            x0_prev: tensor(x0),
            known: vec![known],
            times: vec![step.time],
        };
        let prediction = self.network.forward(prepared, simulated.as_ref(), &state, flows.take());
        *flows = Some(prediction.flows);
        Ok(possible(read(prediction.x0)?))
    }

    /// Tile `number` of images of the whole frame.
    fn tile(&self, job: &Job<'_>, number: usize, images: &[f32]) -> Tensor<4> {
        let tiles = &job.layout.tiles;
        to_tensor(tiles.crop(number, images), tiles.tile, &self.device)
    }

    /// What does not depend on the step, of tile `number`, whose guide is `guide`.
    fn prepare(&self, job: &Job<'_>, number: usize, guide: GuidePlanes) -> Prepared {
        let tensor = |images: &[f32]| self.tile(job, number, images);
        let sensor = TensorData::new(job.sensor.to_vec(), [1, SENSOR_NUMBERS]);
        let prepared = self.network.prepare(&Measured {
            u: tensor(&job.planes.u),
            guide: guide.into_tensor(job.layout.tiles.tile, &self.device),
            sensor: Tensor::from_data(sensor, &self.device),
            frames: job.frames,
        });
        if self.denoises_anew { prepared } else { self.network.denoise_once(prepared) }
    }
}

/// Pictures in [-1, 1].
fn possible(mut images: Vec<f32>) -> Vec<f32> {
    for value in &mut images {
        *value = value.clamp(-1.0, 1.0);
    }
    images
}

/// A window, padded.
struct Job<'a> {
    acquisition: &'a Acquisition,
    /// The sensor in numbers: the same for all tiles and steps.
    sensor: [f32; SENSOR_NUMBERS],
    planes: Planes,
    /// Nothing once all is prepared.
    guide: GuidePlanes,
    frames: usize,
    layout: Layout,
    /// Kept for all steps where there is one tile only: it takes memory.
    prepared: Option<Prepared>,
}

impl Restorer for QudiRestorer {
    fn name(&self) -> &'static str {
        "qudi"
    }

    fn window(&self) -> usize {
        self.window
    }

    fn restore(&mut self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let frames = burst.frames.len();
        if frames < FEWEST_FRAMES {
            return Err(SimError::request(
                format!("a burst of {frames} frames"),
                "--method qudi",
                format!("it needs at least {FEWEST_FRAMES}, better {}", self.window),
            ));
        }
        if !self.generates {
            return self.denoised(burst, acquisition);
        }
        let job = self.job(burst, acquisition)?;
        let mut sum = Moments::default();
        for sample in 0..self.options.samples as u64 {
            sum.add(&self.sample(&job, sample)?);
        }
        Ok(Restored {
            frames: job.layout.frames(&sum.mean()),
            std: (self.options.samples > 1).then(|| job.layout.frames(&sum.deviation())),
        })
    }
}

/// Mean and deviation over samples, in image units.
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

    fn deviation(&self) -> Vec<f32> {
        let pairs = self.sum.iter().zip(&self.squares);
        let variance = pairs
            .map(|(sum, squares)| (squares - sum * sum / self.count) / (self.count - 1.0).max(1.0));
        variance.map(|variance| variance.max(0.0).sqrt()).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use qudi_core::Size;
    use qudi_core::sensor::Sensor;

    /// Initial weights correct nothing; what is left out for them must not be missed in one step, with tiles either.
    #[test]
    fn a_silent_u_net_is_not_missed() {
        let size = Size { height: 24, width: 48 };
        let counts: Vec<Vec<u16>> = (0..3)
            .map(|t| (0..size.pixels()).map(|i| ((i * 7 + t * 13) % 8) as u16).collect())
            .collect();
        let sensor = Sensor::load("qudi-paper").unwrap();
        let gain = sensor.gain_at(3.25).unwrap();
        let acquisition = Acquisition {
            seed: 1,
            first_frame: 0,
            ppp: 3.25,
            exposure: 0.3,
            sensor,
            gain,
            dark: None,
        };
        let (config, device) = (NetworkConfig::preset("tiny").unwrap(), Device::flex());
        let options = SampleOptions { steps: 1, tile: 32, ..SampleOptions::default() };
        let network = config.init(2, &device);
        let mut restorer = QudiRestorer::new(network, &config, 11, options, &device).unwrap();
        assert!(!restorer.generates);
        let burst = BurstView { size, frames: &counts };
        let short = restorer.restore(burst, &acquisition).unwrap().frames;
        restorer.generates = true;
        let whole = restorer.restore(burst, &acquisition).unwrap().frames;
        let laid = config.pre.laid();
        let alignment = aligned(burst, &acquisition, &[]).unwrap();
        let noises =
            (0..counts.len()).map(|frame| laid.of(&alignment, frame).noise_sigma).collect();
        let whole = settled(&alignment, whole, noises, 1.0);
        for (short, whole) in short.iter().zip(&whole) {
            for (short, whole) in short.data.iter().zip(&whole.data) {
                assert!((short - whole).abs() < 1e-5, "{short} and {whole}");
            }
        }
    }
}
