//! The refinement: the first pre-denoiser restores all frames of a window, and the window is aligned again on
//! them. Better frames show where things are, which neighbours fit and what they look like.

use super::config::RegressionConfig;
use super::network::Regression;
use super::predenoiser::PreDenoiser;
use crate::aligned::{Aligned, AlignedNeighbours};
use crate::counts::MAX_IMAGE;
use crate::diffusion::DiffusionRestorer;
use crate::window::Window;
use burn::tensor::{Device, Tensor};
use qudi_burst::{AlignedBurst, ReferenceEstimate};
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::{Error, Frame, Result};
use qudi_layers::Tiling;
use qudi_layers::tensor::to_tensor;
use std::ops::Range;
use std::sync::Arc;

/// Sigma of the errors that a pre-denoised frame does not share with the next one, in units of the sigma of
/// the merged frame's noise.
const UNSHARED_SIGMA: f32 = 0.4;

/// The first pre-denoiser as a restorer of windows.
#[derive(Clone, Debug)]
pub struct Refinement {
    predenoiser: PreDenoiser,
    neighbours: AlignedNeighbours,
    fold: usize,
    tile: usize,
    device: Device,
}

impl Refinement {
    /// Takes the first pre-denoiser of a network, whose weights are on `device`. It sees tiles of `tile`
    /// pixels.
    pub fn new(
        predenoiser: &PreDenoiser,
        config: &RegressionConfig,
        tile: usize,
        device: &Device,
    ) -> Self {
        Self {
            predenoiser: predenoiser.clone(),
            neighbours: config.first_neighbours(),
            fold: config.fold,
            tile,
            device: device.clone(),
        }
    }

    /// Returns the pre-denoiser.
    pub fn predenoiser(&self) -> &PreDenoiser {
        &self.predenoiser
    }

    /// Restores the frames of a window, filtered over time, in image units.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    pub fn restore(&self, burst: &AlignedBurst) -> Result<Vec<Frame>> {
        let tiling = Tiling::new(burst.size(), self.fold, self.tile);
        let predenoise = |aligned: &Aligned<Tensor<4>>| vec![self.predenoiser.predenoise(aligned)];
        let PredenoisedFrames { frames, noise_sigmas, .. } = predenoise_frames(
            "refining",
            burst,
            self.neighbours,
            &tiling,
            &self.device,
            predenoise,
        )?;
        Ok(filter_over_time(burst, frames, noise_sigmas, MAX_IMAGE as f32))
    }
}

/// The frames that bursts are aligned on.
#[derive(Clone, Debug)]
pub enum AlignmentFrames {
    /// The classical reference estimate.
    ReferenceEstimate,
    /// The reference estimate, corrected by the first pre-denoiser.
    Refinement(Box<Refinement>),
    /// Means that the window network predicts.
    Diffusion(Arc<DiffusionRestorer<Window>>),
}

impl AlignmentFrames {
    /// Returns the frames that the second pre-denoiser of a network corrects: the first one's, or those that
    /// `diffusion` predicts. The first one sees tiles of `tile` pixels.
    ///
    /// # Errors
    /// [`Error::Request`] if the network has no first pre-denoiser and there is no diffusion, or both.
    pub fn new(
        network: &Regression,
        config: &RegressionConfig,
        diffusion: Option<Arc<DiffusionRestorer<Window>>>,
        tile: usize,
        device: &Device,
    ) -> Result<Self> {
        match (network.refinement(), diffusion) {
            (Some(first), None) => {
                Ok(Self::Refinement(Box::new(Refinement::new(first, config, tile, device))))
            }
            (None, Some(diffusion)) => Ok(Self::Diffusion(diffusion)),
            (Some(_), Some(_)) => {
                let what = "first frames for a network that restores its own";
                Err(Error::request(what, "network.first", "leave them out"))
            }
            (None, None) => {
                let what = "a network that corrects the frames of a diffusion, without one";
                Err(Error::request(what, "network.first", "name weights of the network `window`"))
            }
        }
    }
}

/// Aligns bursts for one of the two pre-denoisers.
#[derive(Clone, Debug)]
pub struct BurstAligner {
    frames: AlignmentFrames,
    neighbours: AlignedNeighbours,
}

impl BurstAligner {
    /// Creates the aligner of the first pre-denoiser.
    pub fn first(config: &RegressionConfig) -> Self {
        let frames = AlignmentFrames::ReferenceEstimate;
        Self { frames, neighbours: config.first_neighbours() }
    }

    /// Creates the aligner of the second pre-denoiser.
    pub fn second(config: &RegressionConfig, frames: AlignmentFrames) -> Self {
        Self { frames, neighbours: config.second_neighbours() }
    }

    /// Returns the frames that bursts are aligned on.
    pub fn frames(&self) -> &AlignmentFrames {
        &self.frames
    }

    /// Returns the neighbours that are aligned with each frame.
    pub fn neighbours(&self) -> AlignedNeighbours {
        self.neighbours
    }

    /// Aligns the frames of a captured burst.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the sensor's dark rate is unknown, or a device fails.
    pub fn align(&self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<AlignedBurst> {
        let classical = || Ok(AlignedBurst::new(ReferenceEstimate::compute(burst, acquisition)?));
        match &self.frames {
            AlignmentFrames::ReferenceEstimate => classical(),
            AlignmentFrames::Refinement(refinement) => {
                let aligned = classical()?;
                let restored = refinement.restore(&aligned)?;
                Ok(aligned.realign(restored))
            }
            AlignmentFrames::Diffusion(diffusion) => {
                let restored = diffusion.restored(burst, acquisition)?.frames;
                AlignedBurst::on_frames(burst, acquisition, restored)
            }
        }
    }

    /// Aligns a burst and collects the planes of some of its frames.
    ///
    /// # Errors
    /// As [`Self::align`].
    pub fn planes(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        frames: Range<usize>,
    ) -> Result<Aligned<Vec<f32>>> {
        Ok(Aligned::of_frames(&self.align(burst, acquisition)?, self.neighbours, frames))
    }
}

/// The frames of a window, each pre-denoised for itself, in image units.
#[derive(Default)]
pub(crate) struct PredenoisedFrames {
    pub(crate) frames: Vec<Frame>,
    /// Their predicted uncertainty; none where the network predicts none.
    pub(crate) uncertainty: Vec<Frame>,
    /// Sigmas of the merged frames' noise.
    pub(crate) noise_sigmas: Vec<Frame>,
}

/// Pre-denoises the frames of a window one by one, as what `stage` says. `predenoise` gives the frame, and
/// its uncertainty if predicted. While the network works on one frame, the next is aligned, if there are
/// threads for it.
pub(crate) fn predenoise_frames(
    stage: &'static str,
    burst: &AlignedBurst,
    neighbours: AlignedNeighbours,
    tiling: &Tiling,
    device: &Device,
    predenoise: impl Fn(&Aligned<Tensor<4>>) -> Vec<Tensor<4>>,
) -> Result<PredenoisedFrames> {
    let mut all = PredenoisedFrames::default();
    let count = burst.frame_count();
    let mut upcoming = None;
    for number in 0..count {
        progress(stage, number, count)?;
        let frame = upcoming.take().unwrap_or_else(|| neighbours.frame(burst, number));
        // The network stays on this thread, which knows its precision.
        let images = rayon::in_place_scope(|scope| {
            if number + 1 < count && rayon::current_num_threads() > 1 {
                scope.spawn(|_| upcoming = Some(neighbours.frame(burst, number + 1)));
            }
            all.noise_sigmas.push(frame.noise_sigma.clone());
            let padded = |plane: &Vec<f32>| tiling.padded(plane);
            let planes = Aligned::of_frame(frame).map(padded, padded);
            tiling.joined(|tile| {
                let tensor = |plane: &Vec<f32>| {
                    to_tensor(tiling.tiles.crop(tile, plane), tiling.tiles.tile, device)
                };
                Ok(predenoise(&planes.map(tensor, tensor)))
            })
        })?;
        let mut images = images.into_iter();
        all.frames.extend(images.next());
        all.uncertainty.extend(images.next());
    }
    Ok(all)
}

/// Filters frames that were pre-denoised each for itself over time, and clamps them to [0, `max`].
/// `noise_sigmas` belong to the merged frames.
pub(crate) fn filter_over_time(
    burst: &AlignedBurst,
    frames: Vec<Frame>,
    noise_sigmas: Vec<Frame>,
    max: f32,
) -> Vec<Frame> {
    let map = |frames: Vec<Frame>, f: &dyn Fn(f32) -> f32| -> Vec<Frame> {
        let frame = |frame: Frame| {
            let data = frame.data.into_iter().map(f).collect();
            Frame { size: frame.size, data }
        };
        frames.into_iter().map(frame).collect()
    };
    let clamp = |value: f32| value.clamp(0.0, max);
    let frames = map(frames, &clamp);
    let variances = map(noise_sigmas, &|sigma| (UNSHARED_SIGMA * sigma).powi(2));
    map(burst.temporal_filter(&frames, &variances), &clamp)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::NetworkConfig;
    use crate::init_parameters;
    use qudi_core::Size;
    use qudi_core::sensor::Sensor;

    const SIZE: Size = Size { height: 48, width: 80 };

    fn acquisition() -> Acquisition {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        Acquisition::new(sensor, 3.25, 0.45).unwrap_or_else(|e| panic!("{e}")).with_seed(1)
    }

    /// Three frames.
    fn counts() -> Vec<Vec<u16>> {
        let count = |i: usize| ((i * 7 + i / SIZE.width) % 8) as u16;
        (0..3).map(|t| (0..SIZE.pixels()).map(|i| count(i + 13 * t)).collect()).collect()
    }

    /// Returns a small network whose parameters are not zero.
    fn network() -> (RegressionConfig, Regression) {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/regression.toml");
        let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{e}"));
        let config = NetworkConfig::parse(&text, "regression").unwrap_or_else(|e| panic!("{e}"));
        let NetworkConfig::Regression(config) = config else { panic!("{config:?}") };
        let network = init_parameters(config.init(1, &Device::flex()), |_, shape| {
            let count: usize = shape.iter().product();
            (0..count).map(|i| 0.05 * (i as f32).sin()).collect()
        });
        (config, network)
    }

    fn first(network: &Regression) -> &PreDenoiser {
        network.refinement().unwrap_or_else(|| panic!("no first pre-denoiser"))
    }

    /// What lies far from the borders of a tile does not know of them.
    #[test]
    fn refinement_restores_in_tiles_of_the_given_size() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network();
        let aligner = BurstAligner::first(&config);
        let [whole, tiled] = [512, 32].map(|tile| {
            let aligned = aligner.align(burst, &acquisition).unwrap_or_else(|e| panic!("{e}"));
            let refinement = Refinement::new(first(&network), &config, tile, &device);
            refinement.restore(&aligned).unwrap_or_else(|e| panic!("{e}"))
        });
        let pairs = |x: std::ops::Range<usize>| {
            let at = |x: usize| (whole[1].row(4)[x], tiled[1].row(4)[x]);
            x.map(at).collect::<Vec<_>>()
        };
        assert_ne!(whole, tiled);
        assert!(pairs(0..6).iter().all(|(a, b)| (a - b).abs() < 1e-3), "{:?}", pairs(0..6));
    }

    #[test]
    fn only_the_second_predenoiser_sees_per_pixel_alignments() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network();
        let refinement = Refinement::new(first(&network), &config, 512, &device);
        let frames = AlignmentFrames::Refinement(Box::new(refinement));
        let aligners = [BurstAligner::first(&config), BurstAligner::second(&config, frames)];
        let [first_planes, second] = aligners.map(|aligner| {
            let planes = aligner.planes(burst, &acquisition, 1..2);
            planes.unwrap_or_else(|e| panic!("{e}")).to_tensors(SIZE, &device)
        });
        assert_eq!(first_planes.counts.len(), 1 + 2 * config.neighbours);
        assert_eq!(second.counts.len(), 1 + 3 * config.neighbours);
        let frame = first(&network).predenoise(&first_planes);
        assert_eq!(frame.dims(), [1, 1, SIZE.height, SIZE.width]);
        let (frame, sigma) = network.predenoise(&second);
        assert_eq!(frame.dims(), sigma.dims());
    }
}
