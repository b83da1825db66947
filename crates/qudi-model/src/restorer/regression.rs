//! Restoring by regression: the pre-denoised frames, filtered over time.

use super::Model;
use crate::conditioning::{AlignedTensors, Conditioning, CountPlanes, sensor_tensor};
use crate::config::{NetworkConfig, ReferenceKind};
use crate::network::Qudi;
use crate::refinement::{
    PredenoisedFrames, RefinementStage, align, filter_over_time, predenoise_frames,
};
use burn::tensor::Device;
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored};
use qudi_core::{Frame, Result};
use qudi_layers::Tiling;
use qudi_layers::tensor::to_tensor;

/// The largest standard deviation that a value in [0, 1] can have (Popoviciu 1935).
const MAX_UNCERTAINTY: f32 = 0.5;

/// Restores windows with the pre-denoiser alone, without what the U-Net would take: most of the time and
/// memory.
///
/// The pre-denoiser sees no simulated measurement. Each frame is pre-denoised for itself; the temporal filter
/// joins them afterwards.
#[derive(Debug)]
pub struct RegressionRestorer {
    network: Qudi,
    stages: Vec<RefinementStage>,
    config: NetworkConfig,
    tile: usize,
    device: Device,
    window: usize,
}

impl RegressionRestorer {
    pub(super) fn new(model: Model, tile: usize, device: &Device) -> Self {
        let Model { network, config, window, .. } = model;
        let stages = RefinementStage::all(&network, &config, tile, device);
        Self { network, stages, config, tile, device: device.clone(), window }
    }

    pub(super) fn window(&self) -> usize {
        self.window
    }

    pub(super) fn restore(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
    ) -> Result<Restored> {
        if self.config.reference == ReferenceKind::None {
            return self.restore_single_images(burst, acquisition);
        }
        let neighbours = self.config.pre.aligned_neighbours();
        let aligned = align(burst, acquisition, &self.stages)?;
        let tiling = Tiling::new(burst.size, self.config.multiple(), self.tile);
        let predenoise = |aligned: &AlignedTensors| {
            let (d, uncertainty) = self.network.predenoise_aligned(aligned);
            std::iter::once(d).chain(uncertainty).collect()
        };
        let PredenoisedFrames { frames, uncertainty, noise_sigmas } = predenoise_frames(
            "denoising",
            &aligned,
            neighbours,
            &tiling,
            &self.device,
            predenoise,
        )?;
        Ok(restored(filter_over_time(&aligned, frames, noise_sigmas, 1.0), uncertainty))
    }

    /// Pre-denoises frames one by one: without a reference estimate there is no motion to filter along.
    fn restore_single_images(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
    ) -> Result<Restored> {
        let tiling = Tiling::new(burst.size, self.config.multiple(), self.tile);
        let sensor = sensor_tensor(acquisition, &self.device);
        let all = CountPlanes::new(burst, acquisition);
        let pixels = burst.size.pixels();
        let (mut frames, mut uncertainty) = (Vec::new(), Vec::new());
        for number in 0..burst.frames.len() {
            progress("denoising", number, burst.frames.len())?;
            let first = number * pixels;
            let planes = all.map(|plane| tiling.padded(&plane[first..first + pixels]));
            let predenoise = |tile: usize| {
                let tensor = |plane: &[f32]| {
                    let part = tiling.tiles.crop(tile, plane);
                    to_tensor(part, tiling.tiles.tile, &self.device)
                };
                let (d, uncertainty) = self.network.predenoise(&Conditioning {
                    counts: tensor(&planes.y),
                    linear_estimate: tensor(&planes.u),
                    aligned: None,
                    sensor: sensor.clone(),
                    frames: 1,
                });
                Ok(std::iter::once(d).chain(uncertainty).collect())
            };
            let mut images = tiling.joined(predenoise)?.into_iter();
            frames.extend(images.next());
            uncertainty.extend(images.next());
        }
        for value in frames.iter_mut().flat_map(|frame| &mut frame.data) {
            *value = value.clamp(0.0, 1.0);
        }
        Ok(restored(frames, uncertainty))
    }
}

/// Frames and their uncertainty, if it is predicted.
fn restored(frames: Vec<Frame>, mut uncertainty: Vec<Frame>) -> Restored {
    for sigma in uncertainty.iter_mut().flat_map(|frame| &mut frame.data) {
        *sigma = sigma.min(MAX_UNCERTAINTY);
    }
    Restored { frames, std: (!uncertainty.is_empty()).then_some(uncertainty) }
}
