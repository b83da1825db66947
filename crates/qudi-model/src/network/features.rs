//! Spatio-temporal features: 3-D convolutions over the frames, on three levels.

use super::layers::{Bias, Conv3d};
use super::resample::fold;
use crate::config::FeaturesConfig;
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// Features on levels 0, 1 and 2: `[images, channels, h / 2^k, w / 2^k]`.
pub type Pyramid = [Tensor<4>; 3];

/// Features of the measurements.
#[derive(Module, Debug)]
pub struct LowFeatures {
    static_in: Conv3d,
    moving_in: Conv3d,
    half: Conv3d,
    quarter: Conv3d,
    fold: usize,
}

/// Features of the noisy image and the previous estimate.
#[derive(Module, Debug)]
pub struct HighFeatures {
    first: Conv3d,
    half: Conv3d,
    quarter: Conv3d,
    fold: usize,
}

impl FeaturesConfig {
    /// The features of the measurements, weights zero.
    pub fn init_low(&self, fold: usize, device: &Device) -> LowFeatures {
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

    /// The features of the noisy image, weights zero.
    pub fn init_high(&self, fold: usize, device: &Device) -> HighFeatures {
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
    /// What does not depend on the step: `u` is `[images, 1, H, W]`.
    pub fn prepare(&self, u: Tensor<4>, frames: usize) -> Tensor<4> {
        self.static_in.linear(fold(u, self.fold), frames)
    }

    /// `prepared` as from [`Self::prepare`]; `u_sim` and the pre-denoised `d` are `[images, 1, H, W]`.
    pub fn forward(
        &self,
        prepared: Tensor<4>,
        u_sim: Tensor<4>,
        d: Tensor<4>,
        frames: usize,
    ) -> Pyramid {
        let moving = fold(Tensor::cat(vec![u_sim, d], 1), self.fold);
        let full = self.moving_in.add_relu(moving, frames, prepared);
        let half = self.half.halve_relu(full.clone(), frames);
        let quarter = self.quarter.halve_relu(half.clone(), frames);
        [full, half, quarter]
    }
}

impl HighFeatures {
    /// `residual`, `earlier`: the noisy image and the estimate before it around the pre-denoised one, `[images, 1, H, W]`.
    pub fn forward(&self, residual: Tensor<4>, earlier: Tensor<4>, frames: usize) -> Pyramid {
        let planes = fold(Tensor::cat(vec![residual, earlier], 1), self.fold);
        let full = self.first.relu(planes, frames);
        let half = self.half.halve_relu(full.clone(), frames);
        let quarter = self.quarter.halve_relu(half.clone(), frames);
        [full, half, quarter]
    }
}
