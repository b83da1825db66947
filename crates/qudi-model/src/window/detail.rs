//! Detail of merged frames that the prediction lacks. They keep fine texture below their noise, which networks
//! smooth away.

use super::config::{FOLD, IMAGE};
use burn::module::Module;
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d};

/// Channels between the convolutions.
const HIDDEN: usize = 32;

/// Planes that describe the difference of merged frames: itself, and its size.
const PLANES: usize = 2 * IMAGE;

/// The largest difference that convolutions see, in units of usual errors.
const MAX_DIFFERENCE: f32 = 4.0;

/// The gate before it has learnt: `sigmoid(-4) = 0.018` of the difference.
const CLOSED: f32 = -4.0;

/// The network that decides how much of the merged frames is used.
#[derive(Module, Debug)]
pub(super) struct Detail {
    frame: Conv2d,
    difference: Conv2d,
    out: Conv2d,
}

impl Detail {
    /// Creates the convolutions for so many features of the U-Net.
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        Self {
            frame: Conv2d::zeros([features, HIDDEN], 3, Bias::Yes, device),
            difference: Conv2d::zeros([PLANES, HIDDEN], 3, Bias::No, device),
            out: Conv2d::zeros([HIDDEN, IMAGE], 3, Bias::Yes, device),
        }
    }

    /// Adds a part of the difference between merged frames and predicted ones.
    ///
    /// # Shapes
    /// - images, merged: `[images, 1, H, W]` in [-1, 1]
    /// - features: `[images, features, H / 2, W / 2]`
    /// - sigma: of usual errors, `[images, 1, 1, 1]`
    pub(super) fn add(
        &self,
        images: Tensor<4>,
        merged: Tensor<4>,
        features: Tensor<4>,
        sigma: &Tensor<4>,
    ) -> Tensor<4> {
        let difference = merged - images.clone();
        let planes = pixel_unshuffle(difference.clone() / sigma.clone(), FOLD);
        let planes = planes.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE);
        let planes = Tensor::cat(vec![planes.clone(), planes.abs()], 1);
        let hidden = relu(self.difference.add(&[planes], self.frame.linear(&[features])));
        let gate = self.out.linear(&[hidden]) + CLOSED;
        images + sigmoid(pixel_shuffle(gate, FOLD)) * difference
    }
}
