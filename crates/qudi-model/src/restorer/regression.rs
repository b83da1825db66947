//! Restoring by regression: the pre-denoised frames, filtered over time.

use super::Model;
use super::tiling::Tiling;
use crate::conditioning::AlignedTensors;
use crate::config::NetworkConfig;
use crate::network::Qudi;
use crate::refinement::{
    PredenoisedFrames, RefinementStage, align, filter_over_time, predenoise_frames,
};
use burn::tensor::Device;
use qudi_core::Result;
use qudi_core::restorer::{Acquisition, BurstView, Restored};

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
        let neighbours = self.config.pre.aligned_neighbours();
        let aligned = align(burst, acquisition, &self.stages)?;
        let tiling = Tiling::new(burst.size, self.config.multiple(), self.tile);
        let predenoise = |aligned: &AlignedTensors| {
            let (d, uncertainty) = self.network.predenoise(aligned);
            std::iter::once(d).chain(uncertainty).collect()
        };
        let PredenoisedFrames { frames, mut uncertainty, noise_sigmas } =
            predenoise_frames(&aligned, neighbours, &tiling, &self.device, predenoise)?;
        for sigma in uncertainty.iter_mut().flat_map(|frame| &mut frame.data) {
            *sigma = sigma.min(MAX_UNCERTAINTY);
        }
        let frames = filter_over_time(&aligned, frames, noise_sigmas, 1.0);
        Ok(Restored { frames, std: (!uncertainty.is_empty()).then_some(uncertainty) })
    }
}
