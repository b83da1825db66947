//! Refinement stages: a pre-denoiser restores all frames of a window, and the window is aligned again on
//! them.
//!
//! Better frames show where things are, which neighbours fit and what they look like. Each stage has a
//! pre-denoiser of its own; the last pre-denoiser of a network is not a stage but what the U-Net starts from.

use crate::conditioning::{AlignedNeighbours, AlignedPlanes, AlignedTensors, MAX_IMAGE};
use crate::config::NetworkConfig;
use crate::network::{PreDenoiser, Qudi};
use burn::tensor::{Device, Tensor};
use qudi_burst::{AlignedBurst, ReferenceEstimate};
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::{Frame, Result};
use qudi_layers::Tiling;

/// Sigma of the errors that a pre-denoised frame does not share with the next one, in units of the sigma of
/// the merged frame's noise.
const UNSHARED_SIGMA: f32 = 0.4;

/// A refinement stage of a network.
#[derive(Clone, Debug)]
pub struct RefinementStage {
    predenoiser: PreDenoiser,
    neighbours: AlignedNeighbours,
    fold: usize,
    tile: usize,
    device: Device,
}

impl RefinementStage {
    /// The stages of a network of sizes `config` whose weights are on `device`, in their order. They see
    /// tiles of `tile` pixels.
    pub fn all(network: &Qudi, config: &NetworkConfig, tile: usize, device: &Device) -> Vec<Self> {
        let stage = |predenoiser: &PreDenoiser| Self {
            predenoiser: predenoiser.clone(),
            neighbours: config.pre.stage().aligned_neighbours(),
            fold: config.fold,
            tile,
            device: device.clone(),
        };
        network.stages().iter().map(stage).collect()
    }

    /// The pre-denoiser of the stage.
    pub fn predenoiser(&self) -> &PreDenoiser {
        &self.predenoiser
    }

    /// Restores the frames of a window, filtered over time, in image units.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    pub fn restore(&self, burst: &AlignedBurst<'_>) -> Result<Vec<Frame>> {
        let tiling = Tiling::new(burst.size(), self.fold, self.tile);
        let predenoise = |aligned: &AlignedTensors| vec![self.predenoiser.predenoise(aligned)];
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

/// Aligns the frames of a captured burst: on the reference estimate, then on what each stage restores.
///
/// # Errors
/// [`Error`](qudi_core::Error) if the sensor's dark rate is unknown, or a device fails.
pub fn align<'a>(
    burst: BurstView<'_>,
    acquisition: &'a Acquisition,
    stages: &[RefinementStage],
) -> Result<AlignedBurst<'a>> {
    let mut aligned =
        AlignedBurst::new(ReferenceEstimate::compute(burst, acquisition)?, acquisition);
    for stage in stages {
        let restored = stage.restore(&aligned)?;
        aligned = aligned.realign(restored);
    }
    Ok(aligned)
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

/// Pre-denoises the frames of a window one by one, as what `stage` says. `predenoise` gives the frame, and its
/// uncertainty if predicted. While the network works on one frame, the next is aligned, if there are threads for it.
pub(crate) fn predenoise_frames(
    stage: &'static str,
    burst: &AlignedBurst<'_>,
    neighbours: AlignedNeighbours,
    tiling: &Tiling,
    device: &Device,
    predenoise: impl Fn(&AlignedTensors) -> Vec<Tensor<4>>,
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
            let planes = AlignedPlanes::from_frame(frame).map(|plane| tiling.padded(plane));
            tiling.joined(|tile| {
                let planes = planes.map(|plane| tiling.tiles.crop(tile, plane));
                Ok(predenoise(&planes.into_tensors(tiling.tiles.tile, device)))
            })
        })?;
        let mut images = images.into_iter();
        all.frames.extend(images.next());
        all.uncertainty.extend(images.next());
    }
    Ok(all)
}

/// Filters frames that were pre-denoised each for itself over time, and clamps them to [0, `max`].
/// `noise_sigmas` are those of the merged frames.
pub(crate) fn filter_over_time(
    burst: &AlignedBurst<'_>,
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
    use crate::config::PreConfig;
    use crate::network::init_parameters;
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

    /// A network of the sizes of `tiny` whose parameters are not zero.
    fn network(alignments: usize, stages: usize) -> (NetworkConfig, Qudi) {
        let mut config =
            NetworkConfig::parse(include_str!("../../../tests/golden/tiny.toml"), "tiny")
                .unwrap_or_else(|e| panic!("{e}"));
        config.pre = PreConfig { alignments, stages, ..config.pre };
        let network = init_parameters(config.init(1, &Device::flex()), |_, shape| {
            let count: usize = shape.iter().product();
            (0..count).map(|i| 0.05 * (i as f32).sin()).collect()
        });
        (config, network)
    }

    /// What lies far from the borders of a tile does not know of them.
    #[test]
    fn stages_restore_in_tiles_of_the_given_size() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network(1, 1);
        let network = network.with_stage_added(0);
        let [whole, tiled] = [512, 32].map(|tile| {
            let aligned = align(burst, &acquisition, &[]).unwrap_or_else(|e| panic!("{e}"));
            let stage = RefinementStage::all(&network, &config, tile, &device).remove(0);
            stage.restore(&aligned).unwrap_or_else(|e| panic!("{e}"))
        });
        let pairs = |x: std::ops::Range<usize>| {
            let at = |x: usize| (whole[1].row(4)[x], tiled[1].row(4)[x]);
            x.map(at).collect::<Vec<_>>()
        };
        assert_ne!(whole, tiled);
        assert!(pairs(0..6).iter().all(|(a, b)| (a - b).abs() < 1e-3), "{:?}", pairs(0..6));
    }

    /// Weights of further alignments start at zero: the frames stay as they were.
    #[test]
    fn added_stage_ignores_further_alignments_at_first() {
        let device = Device::flex();
        let (before, network) = network(3, 1);
        let after = PreConfig { stages: 2, ..before.pre.clone() };
        let (few, all) = (before.pre.aligned_neighbours(), after.aligned_neighbours());
        let more = all.count() - few.count();
        assert_eq!(more, before.pre.neighbours);
        let plane = |value: f32| vec![value; 256];
        let known = |k: usize| plane(0.1 + 0.01 * k as f32);
        let planes = |further: usize| {
            let with = |known: Vec<Vec<f32>>, value| {
                known.into_iter().chain((0..further).map(|_| plane(value))).collect()
            };
            AlignedPlanes {
                reference: known(0),
                merged: known(1),
                noise_sigma: known(2),
                counts: with((3..4 + few.count()).map(known).collect(), 0.7),
                expected: with((9..9 + few.count()).map(known).collect(), -0.4),
            }
        };
        let tensors =
            |further| planes(further).into_tensors(Size { height: 16, width: 16 }, &device);
        let first = network.predenoise_aligned(&tensors(0)).0;
        let second = network.with_stage_added(more).predenoise_aligned(&tensors(more)).0;
        let difference: f32 = (first - second).abs().max().into_scalar();
        assert!(difference < 1e-6, "{difference}");
    }

    #[test]
    fn only_the_last_predenoiser_sees_per_pixel_alignments() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network(3, 2);
        let stages = RefinementStage::all(&network, &config, 512, &device);
        let neighbours = config.pre.aligned_neighbours();
        let aligned = align(burst, &acquisition, &stages).unwrap_or_else(|e| panic!("{e}"));
        let tensors = AlignedPlanes::new(&aligned, neighbours, 1..2).into_tensors(SIZE, &device);
        assert_eq!(
            tensors.counts.dims(),
            [1, 1 + 3 * config.pre.neighbours, SIZE.height, SIZE.width]
        );
        let (frame, _) = network.predenoise_aligned(&tensors);
        assert_eq!(frame.dims(), [1, 1, SIZE.height, SIZE.width]);
    }
}
