//! Restores windows by regression: pre-denoised frames, filtered over time.

use super::config::RegressionConfig;
use super::network::Regression;
use super::refinement::{
    AlignmentFrames, BurstAligner, PredenoisedFrames, filter_over_time, predenoise_frames,
};
use crate::aligned::Aligned;
use crate::diffusion::DiffusionRestorer;
use crate::restorer::{Model, check_frames, check_tile};
use crate::window::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::Tiling;
use std::sync::Arc;

/// The largest standard deviation that a value in [0, 1] can have (Popoviciu 1935).
const MAX_UNCERTAINTY: f32 = 0.5;

/// Restores windows by regression. Each frame is pre-denoised for itself; the temporal filter joins them
/// afterwards.
#[derive(Debug)]
pub struct RegressionRestorer {
    network: Regression,
    aligner: BurstAligner,
    config: RegressionConfig,
    tile: usize,
    precision: ComputePrecision,
    device: Device,
    window: usize,
}

impl RegressionRestorer {
    /// Creates the restorer of a model whose weights are on `device`. The network sees tiles of `tile`
    /// pixels. `diffusion` predicts the first frames of networks without a first pre-denoiser.
    ///
    /// # Errors
    /// [`Error::Request`](qudi_core::Error::Request) if the tiles are too small, or first frames are missing
    /// or not needed.
    pub fn new(
        model: Model<Regression, RegressionConfig>,
        diffusion: Option<Arc<DiffusionRestorer<Window>>>,
        tile: usize,
        precision: ComputePrecision,
        device: &Device,
    ) -> Result<Self> {
        let Model { network, config, window, .. } = model;
        check_tile(tile, config.multiple())?;
        let first = AlignmentFrames::new(&network, &config, diffusion, tile, device)?;
        let aligner = BurstAligner::second(&config, first);
        Ok(Self { network, aligner, config, tile, precision, device: device.clone(), window })
    }

    fn restored(&self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let aligned = self.aligner.align(burst, acquisition)?;
        let tiling = Tiling::new(burst.size, self.config.multiple(), self.tile);
        let predenoise = |aligned: &Aligned<Tensor<4>>| {
            let (d, uncertainty) = self.network.predenoise(aligned);
            vec![d, uncertainty]
        };
        let PredenoisedFrames { frames, mut uncertainty, noise_sigmas } = predenoise_frames(
            "denoising",
            &aligned,
            self.aligner.neighbours(),
            &tiling,
            &self.device,
            predenoise,
        )?;
        for sigma in uncertainty.iter_mut().flat_map(|frame| &mut frame.data) {
            *sigma = sigma.min(MAX_UNCERTAINTY);
        }
        let frames = filter_over_time(&aligned, frames, noise_sigmas, 1.0);
        Ok(Restored::gray(frames, Some(uncertainty)))
    }
}

impl Restorer for RegressionRestorer {
    fn name(&self) -> &'static str {
        match self.aligner.frames() {
            AlignmentFrames::Diffusion(_) => "qudi-diffusion",
            _ => "qudi-regression",
        }
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
        let restored = with_precision(self.precision, || self.restored(burst, acquisition))?;
        Ok(restored.only(numbers))
    }
}
