//! Spatio-temporal features: 3-D convolutions over the frames, on three levels.

use crate::diffusion::FeaturesConfig;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::pixel_unshuffle;
use qudi_layers::{Bias, Conv3d};

/// Features on levels 0, 1 and 2: `[images, channels, h / 2^k, w / 2^k]`.
pub(crate) type Pyramid = [Tensor<4>; 3];

/// Features of the measurements.
#[derive(Module, Debug)]
pub(crate) struct LowFeatures {
    static_in: Conv3d,
    moving_in: Conv3d,
    half: Conv3d,
    quarter: Conv3d,
    fold: usize,
}

/// Features of the noisy image and the previous estimate.
#[derive(Module, Debug)]
pub(crate) struct HighFeatures {
    first: Conv3d,
    half: Conv3d,
    quarter: Conv3d,
    fold: usize,
}

impl FeaturesConfig {
    /// Creates the features of the measurements, all weights zero.
    pub(crate) fn init_low(&self, fold: usize, device: &Device) -> LowFeatures {
        let [full, half, quarter] = self.low;
        let planes = fold * fold;
        LowFeatures {
            static_in: Conv3d::zeros([planes, full], Bias::Yes, device),
            moving_in: Conv3d::zeros([2 * planes, full], Bias::No, device),
            half: Conv3d::zeros([full, half], Bias::Yes, device),
            quarter: Conv3d::zeros([half, quarter], Bias::Yes, device),
            fold,
        }
    }

    /// Creates the features of the noisy image, all weights zero.
    pub(crate) fn init_high(&self, fold: usize, device: &Device) -> HighFeatures {
        let [full, half, quarter] = self.high;
        HighFeatures {
            first: Conv3d::zeros([2 * fold * fold, full], Bias::Yes, device),
            half: Conv3d::zeros([full, half], Bias::Yes, device),
            quarter: Conv3d::zeros([half, quarter], Bias::Yes, device),
            fold,
        }
    }
}

impl LowFeatures {
    /// Encodes what does not depend on the step.
    ///
    /// # Shapes
    /// - u: `[images, 1, height, width]`
    pub(crate) fn encode(&self, u: Tensor<4>, frames: usize) -> Tensor<4> {
        self.static_in.linear(pixel_unshuffle(u, self.fold), frames)
    }

    /// Computes the features of encoded measurements, simulated measurements and pre-denoised frames `d`.
    ///
    /// # Shapes
    /// - encoded: as [`Self::encode`] gives it
    /// - u_sim, d: `[images, 1, height, width]`
    pub(crate) fn forward(
        &self,
        encoded: Tensor<4>,
        u_sim: Tensor<4>,
        d: Tensor<4>,
        frames: usize,
    ) -> Pyramid {
        let moving = pixel_unshuffle(Tensor::cat(vec![u_sim, d], 1), self.fold);
        let full = self.moving_in.add_relu(moving, frames, encoded);
        let half = self.half.stride2_relu(full.clone(), frames);
        let quarter = self.quarter.stride2_relu(half.clone(), frames);
        [full, half, quarter]
    }
}

impl HighFeatures {
    /// Computes the features of the noisy image and of the previous estimate, as they are or both relative
    /// to the pre-denoised frames.
    ///
    /// # Shapes
    /// - residual, previous: `[images, 1, height, width]`
    pub(crate) fn forward(
        &self,
        residual: Tensor<4>,
        previous: Tensor<4>,
        frames: usize,
    ) -> Pyramid {
        let planes = pixel_unshuffle(Tensor::cat(vec![residual, previous], 1), self.fold);
        let full = self.first.relu(planes, frames);
        let half = self.half.stride2_relu(full.clone(), frames);
        let quarter = self.quarter.stride2_relu(half.clone(), frames);
        [full, half, quarter]
    }
}
