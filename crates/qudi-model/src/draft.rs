//! Rounds of restoring: what a pre-denoiser has made of all frames shows the next one where things are, which frames fit
//! and what its neighbours look like, far better than a classical guide. Each round has a pre-denoiser of its own.

use crate::config::NetworkConfig;
use crate::measurement::{BRIGHTEST, GuidePlanes, Laid};
use crate::network::{PreDenoiser, Qudi};
use crate::restorer::layout::Layout;
use burn::tensor::{Device, Tensor};
use qudi_burst::AlignedBurst;
use qudi_core::{Frame, Result};

/// Deviation of the errors that a pre-denoised frame does not share with the next one, in that of the merged frame's noise.
const UNSHARED: f32 = 0.4;

/// The pre-denoiser of a round before the last one.
#[derive(Clone, Debug)]
pub struct Draft {
    denoiser: PreDenoiser,
    laid: Laid,
    fold: usize,
    tile: usize,
    device: Device,
}

impl Draft {
    /// Those of a network of sizes `config` whose weights are on `device`, in their order; they see tiles of `tile` pixels.
    pub fn all(network: &Qudi, config: &NetworkConfig, tile: usize, device: &Device) -> Vec<Self> {
        let draft = |denoiser: &PreDenoiser| Self {
            denoiser: denoiser.clone(),
            laid: config.pre.of_drafts().laid(),
            fold: config.fold,
            tile,
            device: device.clone(),
        };
        network.drafts().iter().map(draft).collect()
    }

    /// The pre-denoiser of the draft.
    pub fn denoiser(&self) -> &PreDenoiser {
        &self.denoiser
    }

    /// The frames of a window, restored and steadied, in image units.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the device fails.
    pub fn restore(&self, alignment: &AlignedBurst<'_>) -> Result<Vec<Frame>> {
        let layout = Layout::new(alignment.size(), self.fold, self.tile);
        let denoise = |guide: &Tensor<4>| vec![self.denoiser.denoise(guide)];
        let Denoised { frames, noises, .. } =
            denoised(alignment, self.laid, &layout, &self.device, denoise)?;
        Ok(settled(alignment, frames, noises, BRIGHTEST as f32))
    }
}

/// A window's frames, denoised each for itself, in image units.
#[derive(Default)]
pub(crate) struct Denoised {
    pub(crate) frames: Vec<Frame>,
    /// Deviations of their errors; none where the network does not tell them.
    pub(crate) errors: Vec<Frame>,
    /// Deviations of the merged frames' noise.
    pub(crate) noises: Vec<Frame>,
}

/// What `denoise` makes of the frames of a window, one by one: the frame, and the deviation of its errors if it tells it.
pub(crate) fn denoised(
    alignment: &AlignedBurst<'_>,
    laid: Laid,
    layout: &Layout,
    device: &Device,
    denoise: impl Fn(&Tensor<4>) -> Vec<Tensor<4>>,
) -> Result<Denoised> {
    let mut all = Denoised::default();
    for number in 0..alignment.frame_count() {
        let aligned = laid.of(alignment, number);
        all.noises.push(aligned.noise_sigma.clone());
        let guide = GuidePlanes::of_frame(aligned).map(|plane| layout.padded(plane));
        let mut images = layout.denoised(&guide, device, &denoise)?.into_iter();
        all.frames.extend(images.next());
        all.errors.extend(images.next());
    }
    Ok(all)
}

/// Frames of a window that were denoised each for itself, steadied, in [0, `brightest`]; `noises` are the deviations of the
/// merged frames' noise.
pub(crate) fn settled(
    alignment: &AlignedBurst<'_>,
    frames: Vec<Frame>,
    noises: Vec<Frame>,
    brightest: f32,
) -> Vec<Frame> {
    let changed = |frames: Vec<Frame>, f: &dyn Fn(f32) -> f32| -> Vec<Frame> {
        let frame = |frame: Frame| {
            let data = frame.data.into_iter().map(f).collect();
            Frame { size: frame.size, data }
        };
        frames.into_iter().map(frame).collect()
    };
    let possible = |value: f32| value.clamp(0.0, brightest);
    let frames = changed(frames, &possible);
    let errors = changed(noises, &|noise| (UNSHARED * noise).powi(2));
    changed(alignment.temporal_filter(&frames, &errors), &possible)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::PreConfig;
    use crate::measurement::{IMAGES, aligned};
    use crate::network::fill;
    use qudi_burst::ReferenceEstimate;
    use qudi_core::Size;
    use qudi_core::restorer::{Acquisition, BurstView};
    use qudi_core::sensor::Sensor;

    const SIZE: Size = Size { height: 48, width: 80 };

    fn acquisition() -> Acquisition {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let gain = sensor.gain_at(3.25).unwrap_or_else(|e| panic!("{e}"));
        let (seed, first_frame, dark) = (1, 0, None);
        Acquisition { seed, first_frame, ppp: 3.25, exposure: 0.45, sensor, gain, dark }
    }

    /// Three frames.
    fn counts() -> Vec<Vec<u16>> {
        let count = |i: usize| ((i * 7 + i / SIZE.width) % 8) as u16;
        (0..3).map(|t| (0..SIZE.pixels()).map(|i| count(i + 13 * t)).collect()).collect()
    }

    /// The sizes of `tiny`, and some network that has learnt something.
    fn network(motions: usize, rounds: usize) -> (NetworkConfig, Qudi) {
        let mut config = NetworkConfig::preset("tiny").unwrap_or_else(|e| panic!("{e}"));
        config.pre = PreConfig { motions, rounds, ..config.pre };
        let network = fill(config.init(1, &Device::flex()), |_, shape| {
            let count: usize = shape.iter().product();
            (0..count).map(|i| 0.05 * (i as f32).sin()).collect()
        });
        (config, network)
    }

    /// What lies far from the borders of a tile does not know of them.
    #[test]
    fn drafts_see_tiles_of_the_size_asked_for() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network(1, 1);
        let network = network.with_round_more(0);
        let [whole, tiled] = [512, 32].map(|tile| {
            let guide =
                ReferenceEstimate::compute(burst, &acquisition).unwrap_or_else(|e| panic!("{e}"));
            let alignment = AlignedBurst::new(guide, &acquisition);
            let draft = Draft::all(&network, &config, tile, &device).remove(0);
            draft.restore(&alignment).unwrap_or_else(|e| panic!("{e}"))
        });
        let pairs = |x: std::ops::Range<usize>| {
            let at = |x: usize| (whole[1].row(4)[x], tiled[1].row(4)[x]);
            x.map(at).collect::<Vec<_>>()
        };
        assert_ne!(whole, tiled);
        assert!(pairs(0..6).iter().all(|(a, b)| (a - b).abs() < 1e-3), "{:?}", pairs(0..6));
    }
    /// On a first round's frames, and its weights, silent for what is new.
    #[test]
    fn a_round_more_sees_more() {
        let device = Device::flex();
        let (before, network) = network(3, 1);
        let after = PreConfig { rounds: 2, ..before.pre.clone() };
        let more = after.laid().frames() - before.pre.laid().frames();
        assert_eq!(more, before.pre.neighbours);
        let planes = |laid: Laid, fill: &dyn Fn(usize) -> f32| {
            let plane = |k| Tensor::<4>::full([1, 1, 16, 16], fill(k), &device);
            Tensor::cat((0..GuidePlanes::count(laid)).map(plane).collect(), 1)
        };
        let few = before.pre.laid().frames();
        // What is known already, and something else in the new planes: counts, then expectations.
        let old = |k: usize| 0.1 + 0.01 * k as f32;
        let new = |k: usize| match k {
            k if k < IMAGES + 1 + few => old(k),
            k if k < IMAGES + 1 + few + more => 0.7,
            k if k < IMAGES + 1 + 2 * few + more => old(k - more),
            _ => -0.4,
        };
        let first = network.denoise(&planes(before.pre.laid(), &old)).0;
        let network = network.with_round_more(more);
        let second = network.denoise(&planes(after.laid(), &new)).0;
        let difference: f32 = (first - second).abs().max().into_scalar();
        assert!(difference < 1e-6, "{difference}");
    }

    #[test]
    fn only_the_last_round_sees_pixels_go_their_own_ways() {
        let (acquisition, frames, device) = (acquisition(), counts(), Device::flex());
        let burst = BurstView { size: SIZE, frames: &frames };
        let (config, network) = network(3, 2);
        let drafts = Draft::all(&network, &config, 512, &device);
        let laid = config.pre.laid();
        let alignment = aligned(burst, &acquisition, &drafts).unwrap_or_else(|e| panic!("{e}"));
        let guide = GuidePlanes::of(&alignment, laid, 1..2).into_tensor(SIZE, &device);
        let inputs = IMAGES + 1 + 6 * config.pre.neighbours;
        assert_eq!(guide.dims(), [1, inputs, SIZE.height, SIZE.width]);
        let (frame, _) = network.denoise(&guide);
        assert_eq!(frame.dims(), [1, 1, SIZE.height, SIZE.width]);
    }
}
