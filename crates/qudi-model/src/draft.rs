//! Rounds of restoring: what a pre-denoiser has made of all frames shows the next one where things are, which frames fit
//! and what its neighbours look like, far better than a classical guide. Each round has a pre-denoiser of its own.

use crate::config::NetworkConfig;
use crate::layout::Layout;
use crate::measurement::{BRIGHTEST, GuidePlanes};
use crate::network::{PreDenoiser, Qudi};
use burn::tensor::Device;
use qudi_baselines::Alignment;
use qudi_sim::{Frame, Result};

/// Deviation of the errors that a pre-denoised frame does not share with the next one, in that of the merged frame's noise.
const UNSHARED: f32 = 0.4;

/// Side of the tiles that it works on, in pixels.
const TILE: usize = 512;

/// The pre-denoiser of a round before the last one.
#[derive(Clone, Debug)]
pub struct Draft {
    denoiser: PreDenoiser,
    fold: usize,
    device: Device,
}

impl Draft {
    /// Those of a network of sizes `config` whose weights are on `device`, in their order.
    pub fn all(network: &Qudi, config: &NetworkConfig, device: &Device) -> Vec<Self> {
        let draft = |denoiser: &PreDenoiser| Self {
            denoiser: denoiser.clone(),
            fold: config.fold,
            device: device.clone(),
        };
        network.drafts().iter().map(draft).collect()
    }

    pub(crate) fn denoiser(&self) -> &PreDenoiser {
        &self.denoiser
    }

    /// The frames of a window, restored and steadied, in image units.
    ///
    /// # Errors
    /// [`SimError`](qudi_sim::SimError) if the device fails.
    pub fn restore(&self, alignment: &Alignment<'_>, neighbours: usize) -> Result<Vec<Frame>> {
        let frame = |number: usize| {
            let aligned = alignment.of(number, neighbours);
            let noise = aligned.noise.clone();
            let layout = Layout::new(noise.size, self.fold, TILE);
            let guide = GuidePlanes::of_frame(aligned).map(|plane| layout.padded(plane));
            let image =
                layout.denoised(&guide, &self.device, |guide| self.denoiser.denoise(guide))?;
            Ok((layout.frames(&image).remove(0), noise))
        };
        let frames = (0..alignment.frames()).map(frame).collect::<Result<Vec<_>>>()?;
        let (frames, noises): (Vec<Frame>, Vec<Frame>) = frames.into_iter().unzip();
        Ok(settled(alignment, frames, noises, BRIGHTEST as f32))
    }
}

/// Frames of a window that were denoised each for itself, steadied, in [0, `brightest`]; `noises` are the deviations of the
/// merged frames' noise.
pub(crate) fn settled(
    alignment: &Alignment<'_>,
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
    changed(alignment.steadied(&frames, &errors), &possible)
}
