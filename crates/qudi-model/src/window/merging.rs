//! Merging: the mean of linear estimates along the flow, at full resolution. A recurrent state can hold it no
//! better, and has to learn to.

use super::config::{FOLD, IMAGE};
use super::input::MIDDLE;
use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};
use qudi_kernels::{StackParameters, warp, warp_cubic};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d};

/// Channels between the convolutions of the gate.
const HIDDEN: usize = 32;

/// Scale of images, and of their differences.
const SCALE: f32 = 3.0;

/// The gate before it has learnt: `sigmoid(1.5) = 0.82` of the frames before.
const OPEN: f32 = 1.5;

/// Channels of [`Merged::planes`].
pub(super) const MERGED: usize = 2 * IMAGE;

/// The network that decides how much of a merged neighbour is used.
#[derive(Module, Debug)]
pub(super) struct Gate {
    hidden: Conv2d,
    out: Conv2d,
}

/// Merged frames in image units, with the number of frames in every pixel: `[images, 1, H, W]` each.
#[derive(Clone, Debug)]
pub(super) struct Merged {
    pub(super) mean: Tensor<4>,
    pub(super) frames: Tensor<4>,
}

impl Gate {
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        Self {
            hidden: Conv2d::zeros([features + MERGED, HIDDEN], 3, Bias::Yes, device),
            out: Conv2d::zeros([HIDDEN, IMAGE], 3, Bias::Yes, device),
        }
    }

    /// Makes the first convolution ready for several frames.
    pub(super) fn parameters(&self) -> StackParameters {
        StackParameters::new(vec![(self.hidden.weight(), self.hidden.bias_or_zeros())])
    }

    /// Merges the linear estimates of frames with what is merged of their neighbours, along the flow.
    ///
    /// `between` are the [parameters](Self::parameters).
    ///
    /// # Shapes
    /// - linear, restored: `[images, 1, H, W]` in image units
    /// - features: `[images, features, H / 2, W / 2]`
    /// - flow: `[images, 2, H, W]` in pixels
    pub(super) fn merge(
        &self,
        between: &StackParameters,
        neighbours: &Merged,
        linear: Tensor<4>,
        restored: Tensor<4>,
        features: Tensor<4>,
        flow: Tensor<4>,
    ) -> Merged {
        let mean = warp_cubic(neighbours.mean.clone(), flow.clone());
        let frames = warp(neighbours.frames.clone(), flow);
        let difference = pixel_unshuffle((mean.clone() - restored) * SCALE, FOLD);
        let inputs = [features, difference, pixel_unshuffle(frames.clone().log(), FOLD)];
        let gate = self.out.linear(&[between.apply(&inputs)]) + OPEN;
        let used = sigmoid(pixel_shuffle(gate, FOLD)) * frames;
        let frames = used.clone() + 1.0;
        Merged { mean: (mean * used + linear) / frames.clone(), frames }
    }
}

impl Merged {
    /// Returns single frames, before anything is merged with them.
    pub(super) fn single(linear: Tensor<4>) -> Self {
        Self { frames: linear.ones_like(), mean: linear }
    }

    /// Joins what is merged from both sides, each with the frame itself, whose linear estimate is `linear`.
    pub(super) fn joined(earlier: &Self, later: &Self, linear: Tensor<4>) -> Self {
        let sum = |merged: &Self| merged.mean.clone() * merged.frames.clone();
        let frames = earlier.frames.clone() + later.frames.clone() - 1.0;
        Self { mean: (sum(earlier) + sum(later) - linear) / frames.clone(), frames }
    }

    /// Returns the planes that networks see, `[images, 8, H / 2, W / 2]`.
    pub(super) fn planes(&self) -> Tensor<4> {
        let image = pixel_unshuffle((self.mean.clone() - MIDDLE) * SCALE, FOLD);
        Tensor::cat(vec![image, pixel_unshuffle(self.frames.clone().log(), FOLD)], 1)
    }
}
