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
use crate::sensor::{response_tensor, sensor_tensor};
use burn::tensor::{Device, Tensor};
use qudi_burst::BurstMotion;
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Result};
use qudi_kernels::{ComputePrecision, is_flex, with_precision};
use qudi_layers::tensor::{read, to_tensor};
use qudi_layers::{TILE, Tiling};
use std::cell::RefCell;
use std::ops::Range;
use std::sync::Arc;

/// Pixels of the frames that pass through the network at once, on devices other than the processor: two tiles
/// of 512 x 512 in windows of 11 frames.
const BATCH_PIXELS: usize = 1 << 23;

/// The largest number of bytes of encoded tiles that are kept for later steps. A single tile is always kept.
const MAX_KEPT_BYTES: usize = 1 << 30;

/// What finds the motion between frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlowSource {
    /// Patches, matched on the processor in the counts of all frames and on better frames.
    Matched,
    /// The network, on its device.
    Learnt,
}

impl FlowSource {
    /// Returns the name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Matched => "matched",
            Self::Learnt => "learnt",
        }
    }
}

/// Options of sampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Reverse steps. One gives the mean of all pictures that fit; more give sharper ones.
    pub steps: usize,
    /// Spacing of their timesteps.
    pub spacing: TimestepSpacing,
    /// Sampler.
    pub sampler: Sampler,
    /// Passes of encoding: each one after the first sees the frames that the one before predicts.
    pub passes: usize,
    /// What finds the motion; none for the best that the network can follow.
    pub flow: Option<FlowSource>,
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
            passes: 1,
            flow: None,
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
    /// Pixels of the frames of a batch of tiles; a batch has at least one tile.
    batch_pixels: usize,
}

/// A window, padded.
struct Window<'a, E> {
    acquisition: &'a Acquisition,
    sensor: Tensor<2>,
    response: Tensor<2>,
    counts: CountPlanes,
    /// Counts as they are; none if no motion is found in them.
    raw: Option<Vec<u16>>,
    /// The map of dark rates, if one is known.
    dark: Option<Vec<f32>>,
    frames: usize,
    tiling: Tiling,
    /// Numbers of the tiles that pass through the network at once.
    batches: Vec<Range<usize>>,
    kept: RefCell<Kept<E>>,
}

impl<E> Window<'_, E> {
    /// Prepares the search for the motion in the counts of a batch of tiles.
    fn motion(&self, batch: usize) -> Vec<Arc<BurstMotion>> {
        let Some(raw) = &self.raw else { return Vec::new() };
        let tiles = &self.tiling.tiles;
        let size = tiles.tile;
        let of = |tile: usize| {
            let counts = tiles.crop(tile, raw);
            let frames: Vec<_> = counts.chunks_exact(size.pixels()).map(<[u16]>::to_vec).collect();
            let view = BurstView { size, frames: &frames };
            let dark = self.dark.as_ref().map(|map| tiles.crop(tile, map));
            let acquisition = Acquisition { dark, ..self.acquisition.clone() };
            Arc::new(BurstMotion::new(view, &acquisition))
        };
        self.batches[batch].clone().map(of).collect()
    }
}

/// Encoded batches of tiles that later steps use again.
struct Kept<E> {
    batches: Vec<Option<E>>,
    bytes: usize,
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
        let Model { network, config, window, passes } = model;
        if options.passes == 0 || (options.passes > 1 && passes < 2) {
            let what = match options.passes {
                0 => "no passes at all".to_owned(),
                asked => format!("{asked} passes of a network that has learnt one"),
            };
            let help = "use 1, or weights of a recipe that sets train.passes, as `window` does";
            return Err(Error::request(what, "passes", help));
        }
        if options.flow == Some(FlowSource::Matched) && !network.follows_counts() {
            let help = "use `learnt`, or weights of the network `window`";
            return Err(Error::request("matched flow for a network of another kind", "flow", help));
        }
        check_tile(options.tile, N::multiple(&config))?;
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        // The processor's results do not depend on batches, and small ones stay in its caches.
        let batch_pixels = if is_flex(device) { 0 } else { BATCH_PIXELS };
        let device = device.clone();
        Ok(Self { network, config, schedule, options, device, window, batch_pixels })
    }

    /// Returns the network.
    pub fn network(&self) -> &N {
        &self.network
    }

    /// Restores all frames of a window, in the precision that holds where this is called.
    pub(crate) fn restored(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
    ) -> Result<Restored> {
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
        let frames = burst.frames.len();
        let matched =
            self.network.follows_counts() && self.options.flow != Some(FlowSource::Learnt);
        let raw = || burst.frames.concat();
        let (count, pixels) = (tiling.tiles.count(), tiling.tiles.tile.pixels() * frames);
        let tiles = (self.batch_pixels / pixels).clamp(1, count);
        let batches = (0..count).step_by(tiles).map(|first| first..(first + tiles).min(count));
        let batches: Vec<_> = batches.collect();
        Window {
            acquisition,
            sensor: sensor_tensor(acquisition, &self.device),
            response: response_tensor(acquisition, &self.device),
            counts: CountPlanes::new(burst, acquisition).map(|plane| tiling.padded(plane)),
            raw: matched.then(|| tiling.padded(&raw())),
            dark: acquisition.dark.as_ref().map(|map| tiling.padded(map)),
            frames,
            tiling,
            kept: RefCell::new(Kept { batches: vec![None; batches.len()], bytes: 0 }),
            batches,
        }
    }

    /// Draws one sample of a window, padded, in [-1, 1].
    fn sample(&self, window: &Window<'_, N::Encoded>, number: u64) -> Result<Vec<f32>> {
        let noise = Noise::new(window.acquisition.seed, number);
        let pixels = window.tiling.size.pixels();
        let noise_of = |step: usize| -> Result<Vec<f32>> {
            let frames = (window.acquisition.first_frame..).take(window.frames);
            let values: Vec<f32> =
                frames.flat_map(|frame| noise.frame(frame, step, pixels)).collect();
            // A picture is better where merging averages the guesses, an uncertainty where it does not.
            if N::MOVES_NOISE && self.options.samples > 1 {
                self.moved(window, values)
            } else {
                Ok(values)
            }
        };
        let mut flows: Vec<Option<N::Flows>> = vec![None; window.batches.len()];
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
            for (batch, flows) in flows.iter_mut().enumerate() {
                let parts =
                    self.predict(window, batch, simulated.as_ref(), [x, x0], step, flows)?;
                let tiles = window.batches[batch].clone();
                let length = parts.len() / tiles.len();
                for (tile, part) in tiles.zip(parts.chunks_exact(length)) {
                    window.tiling.tiles.blend(tile, part, &mut prediction);
                }
            }
            Ok(prediction)
        };
        let fresh = |step: &Step| {
            if step.sigma > 0.0 { noise_of(step.number) } else { Ok(Vec::new()) }
        };
        sample(&steps, noise_of(0)?, predict, fresh)
    }

    /// Makes noise of a whole window move with the scene.
    fn moved(&self, window: &Window<'_, N::Encoded>, noise: Vec<f32>) -> Result<Vec<f32>> {
        let tiles = &window.tiling.tiles;
        let mut moved = noise.clone();
        for (batch, numbers) in window.batches.iter().enumerate() {
            let mut parts: Vec<f32> =
                numbers.clone().flat_map(|number| tiles.crop(number, &noise)).collect();
            N::move_noise(&self.encoded(window, batch)?, &mut parts)?;
            let length = parts.len() / numbers.len();
            for (number, part) in numbers.clone().zip(parts.chunks_exact(length)) {
                tiles.place(number, part, &mut moved);
            }
        }
        Ok(moved)
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

    /// Predicts the clean images of the tiles of a batch, in [-1, 1], from the noisy image and the previous
    /// estimate.
    fn predict(
        &self,
        window: &Window<'_, N::Encoded>,
        batch: usize,
        simulated: Option<&CountPlanes>,
        [x, x0]: [&[f32]; 2],
        step: &Step,
        flows: &mut Option<N::Flows>,
    ) -> Result<Vec<f32>> {
        let tensor = |images: &[f32]| self.tiles(window, batch, images);
        let tiles = window.batches[batch].len();
        let encoded = self.encoded(window, batch)?;
        let simulated = simulated.map(|planes| Simulated {
            y: tensor(&planes.y),
            u: tensor(&planes.u),
            exists: vec![true; tiles],
        });
        let has_previous = step.number > 1 && self.network.uses(Part::SelfConditioning);
        let state = DiffusionState {
            x_t: tensor(x),
            x0_prev: tensor(x0),
            has_previous: vec![has_previous; tiles],
            timesteps: vec![step.timestep; tiles],
        };
        let image = read(self.network.denoise(&encoded, simulated.as_ref(), &state, flows))?;
        Ok(image.into_iter().map(|value| value.clamp(-1.0, 1.0)).collect())
    }

    /// Crops the tiles of a batch from images of the whole frame, as bursts one after the other.
    fn tiles(&self, window: &Window<'_, N::Encoded>, batch: usize, images: &[f32]) -> Tensor<4> {
        let tiles = &window.tiling.tiles;
        let numbers = window.batches[batch].clone();
        let values = numbers.flat_map(|number| tiles.crop(number, images)).collect();
        to_tensor(values, tiles.tile, &self.device)
    }

    /// Returns what does not depend on the step, of a batch of tiles: kept from an earlier step or sample, or
    /// computed now.
    fn encoded(&self, window: &Window<'_, N::Encoded>, batch: usize) -> Result<N::Encoded> {
        let mut kept = window.kept.borrow_mut();
        if let Some(encoded) = &kept.batches[batch] {
            return Ok(encoded.clone());
        }
        let conditioning = Conditioning {
            counts: self.tiles(window, batch, &window.counts.y),
            linear_estimate: self.tiles(window, batch, &window.counts.u),
            sensor: window.sensor.clone().repeat_dim(0, window.batches[batch].len()),
            response: window.response.clone().repeat_dim(0, window.batches[batch].len()),
            frames: window.frames,
            motion: window.motion(batch),
        };
        let encoded = self.network.encode(&conditioning, self.options.passes)?;
        let bytes = kept.bytes + N::encoded_bytes(&encoded);
        let used_again = self.options.steps * self.options.samples > 1;
        if used_again && (bytes <= MAX_KEPT_BYTES || window.batches.len() == 1) {
            kept.bytes = bytes;
            kept.batches[batch] = Some(encoded.clone());
        }
        Ok(encoded)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::window::{Window, WindowConfig};
    use qudi_core::Size;
    use qudi_core::sensor::Sensor;

    fn config() -> WindowConfig {
        WindowConfig {
            widths: [32; 3],
            flow: [32; 3],
            state: 32,
            cell_blocks: 1,
            linear_entries: false,
        }
    }

    /// Restores a window of `size` in tiles of 32 pixels, in batches of so many pixels, in so many steps,
    /// with the dark rates of its pixels.
    fn restore(size: Size, batch_pixels: usize, steps: usize, dark: Option<Vec<f32>>) -> Vec<f32> {
        let device = Device::flex();
        let pixel = |i: usize, t: usize| ((i * 7 + t * 13 + i / size.width) % 8) as u16;
        let frame = |t: usize| (0..size.pixels()).map(|i| pixel(i, t)).collect();
        let counts: Vec<Vec<u16>> = (0..3).map(frame).collect();
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap_or_else(|e| panic!("{e}"));
        let acquisition = Acquisition { dark, ..acquisition };
        let network: Window = config().init(1, &device);
        let model = Model { network, config: config(), window: 11, passes: 2 };
        let options = SampleOptions { steps, passes: 2, tile: 32, ..SampleOptions::default() };
        let mut restorer =
            DiffusionRestorer::new(model, options, &device).unwrap_or_else(|e| panic!("{e}"));
        restorer.batch_pixels = batch_pixels;
        let burst = BurstView { size, frames: &counts };
        let restored = restorer.restored(burst, &acquisition).unwrap_or_else(|e| panic!("{e}"));
        restored.frames.into_iter().flat_map(|frame| frame.data).collect()
    }

    /// A batch of four tiles and one of two give what single tiles do.
    #[test]
    fn batches_of_tiles_are_tiles_one_by_one() {
        let size = Size { height: 48, width: 80 };
        assert_eq!(Tiling::new(size, 8, 32).tiles.count(), 6, "the batches of this test");
        let single = restore(size, 0, 3, None);
        let batches = restore(size, 4 * 3 * 32 * 32, 3, None);
        let pairs = single.iter().zip(&batches);
        assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-4), "batches differ from tiles");
        assert!(single.iter().any(|&value| value != single[0]), "a flat picture tests nothing");
    }

    /// Frames are padded and cut into tiles with their map: hot pixels on the right change nothing on the
    /// left.
    #[test]
    fn a_map_of_dark_rates_lies_on_its_frame() {
        let size = Size { height: 21, width: 76 };
        let map = |hot: f32| {
            let rate = |i: usize| if i % size.width < 60 { 1.6 } else { hot };
            Some((0..size.pixels()).map(rate).collect())
        };
        // Tiles begin at 0, 24 and 48. Every step carries changes as far as the network sees in the next one.
        for (steps, least, first) in [(1, 0.0, 48), (3, 1e-4, 32)] {
            let [flat, hot] = [1.6, 3.2].map(|rate| restore(size, 0, steps, map(rate)));
            let column = |i: usize| i % size.width;
            let changes = |i: &usize| (flat[*i] - hot[*i]).abs() > least;
            let changed: Vec<usize> = (0..flat.len()).filter(changes).map(column).collect();
            assert!(changed.iter().all(|&column| column >= first), "{steps} steps: {changed:?}");
            assert!(changed.iter().any(|&column| column > 60), "hot pixels change nothing");
        }
    }
}
