//! Merging of predicted frames: each with its nearest neighbours along the flow, as far as they agree. What a
//! frame's prediction gets wrong, its neighbours often do not.

use super::config::{FOLD, IMAGE};
use super::merging::{OF_FRAMES, inverse_weight};
use super::motion::paths::Paths;
use burn::module::Module;
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d};

/// Neighbours on either side.
const NEIGHBOURS: usize = 6;

/// Channels between the convolutions.
const HIDDEN: usize = 32;

/// Planes that describe a neighbour: differences, their sizes, their mean square around, and its distance.
const PLANES: usize = 2 * IMAGE + 2;

/// The largest difference that convolutions see, in units of usual errors.
const MAX_DIFFERENCE: f32 = 4.0;

/// Bounds of the logarithm of a neighbour's weight; a frame's own is zero.
const LOG_WEIGHT: [f32; 2] = [-12.0, 4.0];

/// The network that weights neighbours.
#[derive(Module, Debug)]
pub(super) struct Agreement {
    frame: Conv2d,
    neighbour: Conv2d,
    out: Conv2d,
}

impl Agreement {
    /// Creates the convolutions for so many features of the U-Net.
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        Self {
            frame: Conv2d::zeros([features, HIDDEN], 3, Bias::Yes, device),
            neighbour: Conv2d::zeros([PLANES, HIDDEN], 3, Bias::No, device),
            out: Conv2d::zeros([HIDDEN, IMAGE], 3, Bias::Yes, device),
        }
    }

    /// Merges every frame with its neighbours.
    ///
    /// # Shapes
    /// - images: `[bursts * frames, 1, H, W]`
    /// - features: `[bursts * frames, features, H / 2, W / 2]`
    /// - sigma: of usual errors, `[bursts * frames, 1, 1, 1]`
    pub(super) fn forward(
        &self,
        images: Tensor<4>,
        features: Tensor<4>,
        sigma: &Tensor<4>,
        paths: &Paths,
    ) -> Tensor<4> {
        let of_frames = self.frame.linear(&[features]);
        let mut sum = images.clone();
        let mut total = images.ones_like();
        for (place, aligned) in paths.aligned(&images, NEIGHBOURS) {
            let difference = aligned.clone() - place.part(&images, false);
            let difference = difference / place.part(sigma, false);
            let formula = -inverse_weight(difference.clone(), OF_FRAMES).log();
            let planes = pixel_unshuffle(difference.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE), FOLD);
            let far = formula.ones_like() * (place.distance as f32 - 2.0);
            let planes = Tensor::cat(vec![planes.clone(), planes.abs(), formula.clone(), far], 1);
            let of_frame = place.part(&of_frames, false);
            let hidden = relu(self.neighbour.add(&[planes], of_frame));
            let log_weight = pixel_shuffle(self.out.linear(&[hidden]) + formula, FOLD);
            let weight = log_weight.clamp(LOG_WEIGHT[0], LOG_WEIGHT[1]).exp();
            let both = place.whole(Tensor::cat(vec![aligned * weight.clone(), weight], 1));
            sum = sum + both.clone().narrow(1, 0, 1);
            total = total + both.narrow(1, 1, 1);
        }
        sum / total
    }
}
