//! Quanta Diffusion as a method: windows of counts in, clean frames and their deviation out.

use crate::config::{NetworkConfig, Part};
use crate::measurement::{GuidePlanes, Planes, sensor_numbers};
use crate::network::{Flows, Measured, Prepared, Qudi, SENSOR_NUMBERS, Simulated, State};
use crate::noise::Noise;
use crate::physics::LoopSensor;
use crate::sampler::{Sampler, Step, TIMES};
use crate::schedule::NoiseSchedule;
use crate::tensor::{read, to_tensor};
use crate::tiles::Tiles;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_baselines::steadied;
use qudi_sim::restore::{BurstView, Context, Restored, Restorer};
use qudi_sim::{Frame, Result, SimError, Size};

/// Fewest frames that the fusion makes sense of.
pub const FEWEST_FRAMES: usize = 3;

/// Deviation of the errors that a pre-denoised frame does not share with the next one, in that of the merged frame's noise.
const UNSHARED: f32 = 0.4;

/// How to sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Reverse steps: 1 is the mean of all pictures that fit, more are sharper.
    pub steps: usize,
    /// How noise leaves.
    pub sampler: Sampler,
    /// Pictures drawn; their mean is the result, their deviation its uncertainty.
    pub samples: usize,
    /// Side of the tiles that the network sees, in pixels.
    pub tile: usize,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self { steps: 1, sampler: Sampler::Ddim, samples: 1, tile: 512 }
    }
}

/// The network with everything that restoring needs.
#[derive(Debug)]
pub struct QudiRestorer {
    network: Qudi,
    /// Whether its U-Net says anything.
    generates: bool,
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
        if !(1..=TIMES).contains(&options.steps) {
            let what = format!("{} reverse steps", options.steps);
            return Err(SimError::request(what, "--steps", format!("use 1 to {TIMES}")));
        }
        if options.samples == 0 {
            return Err(SimError::request("no samples at all", "--samples", "draw at least 1"));
        }
        let generates = network.generates()?;
        if options.samples > 1 && !generates {
            return Err(SimError::request(
                "these weights make the same picture of any noise: samples would not differ",
                "--samples",
                "leave it out, or use weights that learnt with train.loss.prediction above 0 (docs/training.md)",
            ));
        }
        let smallest = 4 * config.multiple();
        if options.tile < smallest {
            let what = format!("tiles of {} pixels", options.tile);
            let help = format!("this network needs at least {smallest}");
            return Err(SimError::request(what, "--tile", help));
        }
        let schedule = NoiseSchedule::cosine(TIMES);
        let (config, device) = (config.clone(), device.clone());
        Ok(Self { network, generates, config, schedule, options, device, window })
    }

    /// A window whose planes are padded to what the network wants.
    fn job<'a>(&self, burst: BurstView<'_>, context: &'a Context) -> Result<Job<'a>> {
        let frames = burst.frames.len();
        let multiple = self.config.multiple();
        let size = Size {
            height: burst.size.height.next_multiple_of(multiple),
            width: burst.size.width.next_multiple_of(multiple),
        };
        let planes = Planes::of(burst, context);
        let pad = |images: &[f32]| padded(images, burst.size, size);
        let planes = Planes { y: pad(&planes.y), u: pad(&planes.u) };
        let guide = GuidePlanes::of(burst, context, self.config.pre.neighbours)?.map(pad);
        let side = self.options.tile / multiple * multiple;
        let tiles = Tiles::new(size, side, (side / 8).next_multiple_of(multiple), multiple);
        let sensor = sensor_numbers(context);
        let mut job = Job { context, sensor, planes, guide, frames, size, tiles, prepared: None };
        if self.generates && job.tiles.count() == 1 {
            job.prepared = Some(self.prepare(&job, 0));
        }
        Ok(job)
    }

    /// One sample of a window whose planes are padded to `size`.
    fn sample(&self, job: &Job<'_>, sample: u64) -> Result<Vec<f32>> {
        if !self.generates {
            return self.denoised(job);
        }
        let noise = Noise::new(job.context.seed, sample);
        let frames = || (job.context.first_frame..).take(job.frames);
        let pixels = job.size.pixels();
        let mut x: Vec<f32> = frames().flat_map(|frame| noise.frame(frame, 0, pixels)).collect();
        let mut x0 = vec![0.0; x.len()];
        let nothing = x0.clone();
        let mut flows: Vec<Option<Flows>> = vec![None; job.tiles.count()];
        for step in self.options.sampler.steps(&self.schedule, self.options.steps) {
            let simulated = if step.number == 1 || self.config.lacks(Part::Physics) {
                None
            } else {
                let sensor = LoopSensor::at(job.context, step.time, TIMES);
                let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
                let seed = noise.photon_seed(step.number);
                Some(sensor.measure(&images, job.size, job.context.first_frame, seed)?)
            };
            if self.config.flow.steps.contains(&step.number) {
                flows.fill(None);
            }
            let given = if self.config.lacks(Part::SelfConditioning) { &nothing } else { &x0 };
            let mut next = vec![0.0; x.len()];
            for (number, flows) in flows.iter_mut().enumerate() {
                let tile =
                    self.predict(job, number, simulated.as_ref(), &x, given, &step, flows)?;
                job.tiles.blend(number, &tile, &mut next);
            }
            x0 = next;
            let fresh = frames().flat_map(|frame| noise.frame(frame, step.number, pixels));
            step.advance(&mut x, &x0, fresh);
        }
        Ok(x0)
    }

    /// The network's clean image of one tile, in [-1, 1].
    #[allow(clippy::too_many_arguments)]
    fn predict(
        &self,
        job: &Job<'_>,
        number: usize,
        simulated: Option<&Planes>,
        x: &[f32],
        x0: &[f32],
        step: &Step,
        flows: &mut Option<Flows>,
    ) -> Result<Vec<f32>> {
        let tensor = |images: &[f32]| self.tile(job, number, images);
        let fresh;
        let prepared = if let Some(prepared) = &job.prepared {
            prepared
        } else {
            fresh = self.prepare(job, number);
            &fresh
        };
        let simulated = simulated.map(|planes| Simulated {
            y: tensor(&planes.y),
            u: tensor(&planes.u),
            exists: vec![true],
        });
        let state = State { x_t: tensor(x), x0_prev: tensor(x0), times: vec![step.time] };
        let prediction = self.network.forward(prepared, simulated.as_ref(), &state, flows.take());
        *flows = Some(prediction.flows);
        Ok(possible(read(prediction.x0)?))
    }

    /// The same without what a U-Net that corrects nothing would take, frame by frame: most of the time and memory. In one
    /// step: such weights have seen no simulated measurement in training either, and more would only disturb them.
    fn denoised(&self, job: &Job<'_>) -> Result<Vec<f32>> {
        let pixels = job.size.pixels();
        let mut x0 = vec![0.0; job.frames * pixels];
        for number in 0..job.tiles.count() {
            let mut tile = Vec::new();
            for frame in 0..job.frames {
                let of =
                    |images: &[f32]| job.tiles.crop(number, &images[frame * pixels..][..pixels]);
                let guide = job.guide.map(of).to_tensor(job.tiles.tile, &self.device);
                tile.extend(read(self.network.denoise(&guide, 1) * 2.0 - 1.0)?);
            }
            job.tiles.blend(number, &possible(tile), &mut x0);
        }
        Ok(x0)
    }

    /// Tile `number` of images of the whole frame.
    fn tile(&self, job: &Job<'_>, number: usize, images: &[f32]) -> Tensor<4> {
        to_tensor(job.tiles.crop(number, images), job.tiles.tile, &self.device)
    }

    fn prepare(&self, job: &Job<'_>, number: usize) -> Prepared {
        let tensor = |images: &[f32]| self.tile(job, number, images);
        let guide = job.guide.map(|images| job.tiles.crop(number, images));
        let sensor = TensorData::new(job.sensor.to_vec(), [1, SENSOR_NUMBERS]);
        self.network.prepare(&Measured {
            u: tensor(&job.planes.u),
            guide: guide.to_tensor(job.tiles.tile, &self.device),
            sensor: Tensor::from_data(sensor, &self.device),
            frames: job.frames,
        })
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
    context: &'a Context,
    /// The sensor in numbers: the same for all tiles and steps.
    sensor: [f32; SENSOR_NUMBERS],
    planes: Planes,
    guide: GuidePlanes,
    frames: usize,
    size: Size,
    tiles: Tiles,
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

    fn restore(&mut self, burst: BurstView<'_>, context: &Context) -> Result<Restored> {
        let frames = burst.frames.len();
        if frames < FEWEST_FRAMES {
            return Err(SimError::request(
                format!("a burst of {frames} frames"),
                "--method qudi",
                format!("it needs at least {FEWEST_FRAMES}, better {}", self.window),
            ));
        }
        let job = self.job(burst, context)?;
        let size = job.size;
        let mut sum = Moments::default();
        for sample in 0..self.options.samples as u64 {
            sum.add(&self.sample(&job, sample)?);
        }
        let images = |values: &[f32]| -> Vec<Frame> {
            let images = values.chunks_exact(size.pixels());
            images.map(|image| cropped(image, size, burst.size)).collect()
        };
        let mut restored = images(&sum.mean());
        if !self.generates {
            // Fusion has no part in these: each frame was denoised for itself.
            let errors = |noise: &f32| (UNSHARED * noise).powi(2);
            let errors: Vec<f32> = job.guide.noise().iter().map(errors).collect();
            restored = steadied(&restored, &images(&errors));
            let values = restored.iter_mut().flat_map(|frame| &mut frame.data);
            values.for_each(|value| *value = value.min(1.0));
        }
        Ok(Restored {
            frames: restored,
            std: (self.options.samples > 1).then(|| images(&sum.deviation())),
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

/// Images mirrored at their lower and right edges.
fn padded(images: &[f32], from: Size, to: Size) -> Vec<f32> {
    // 0 1 2 3 2 1 0 1 2 ...: the edge itself is not repeated.
    let mirror = |place: usize, length: usize| {
        let period = (2 * length - 2).max(1);
        let place = place % period;
        if place < length { place } else { period - place }
    };
    let mut values = Vec::with_capacity(images.len() / from.pixels() * to.pixels());
    for image in images.chunks_exact(from.pixels()) {
        for y in 0..to.height {
            let row = mirror(y, from.height) * from.width;
            values.extend((0..to.width).map(|x| image[row + mirror(x, from.width)]));
        }
    }
    values
}

fn cropped(image: &[f32], from: Size, to: Size) -> Frame {
    let rows = image.chunks_exact(from.width).take(to.height);
    Frame { size: to, data: rows.flat_map(|row| &row[..to.width]).copied().collect() }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use qudi_sim::sensor::Sensor;

    /// Initial weights correct nothing; what is left out for them must not be missed, with tiles and several steps either.
    #[test]
    fn a_silent_u_net_is_not_missed() {
        let size = Size { height: 24, width: 48 };
        let counts: Vec<Vec<u16>> = (0..3)
            .map(|t| (0..size.pixels()).map(|i| ((i * 7 + t * 13) % 8) as u16).collect())
            .collect();
        let sensor = Sensor::load("qudi-paper").unwrap();
        let gain = sensor.gain_at(3.25).unwrap();
        let context =
            Context { seed: 1, first_frame: 0, ppp: 3.25, exposure: 0.3, sensor, gain, dark: None };
        let (config, device) = (NetworkConfig::preset("tiny").unwrap(), Device::flex());
        let options = SampleOptions { steps: 2, tile: 32, ..SampleOptions::default() };
        let restored = |generates: bool| {
            let network = config.init(2, &device);
            let restorer = QudiRestorer::new(network, &config, 11, options, &device).unwrap();
            assert!(!restorer.generates);
            let restorer = QudiRestorer { generates, ..restorer };
            let job = restorer.job(BurstView { size, frames: &counts }, &context).unwrap();
            restorer.sample(&job, 0).unwrap()
        };
        for (short, whole) in restored(false).iter().zip(&restored(true)) {
            assert!((short - whole).abs() < 1e-5, "{short} and {whole}");
        }
    }
}
