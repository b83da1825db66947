//! The shape of pre-denoiser and U-Net: residual stacks from fine to coarse and back, with skips.

use super::config::LEVELS;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::pixel_norm;
use qudi_layers::resample::{avg_pool2, pixel_shuffle};
use qudi_layers::{Bias, Conv2d, ResidualStack};

/// Channels that a coarser level hands to the next finer one.
const HANDED_UP: usize = 32;

/// Features at half, a quarter and an eighth of the resolution, finest first.
pub(crate) type Pyramid = [Tensor<4>; LEVELS];

/// How the stacks of the coarser levels begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CoarseEntry {
    /// With a ReLU. All of its units went off for every input in training, and with them both levels
    /// (docs/notes/network/dead-levels.md).
    Rectified,
    /// Without: a gradient always passes.
    Linear,
}

/// Residual stacks from fine to coarse and back.
#[derive(Module, Debug)]
pub(crate) struct Hourglass {
    encoder: Vec<ResidualStack>,
    up: Vec<Conv2d>,
    decoder: Vec<ResidualStack>,
}

impl Hourglass {
    /// Creates the layers for so many `inputs` and so many planes of `conditions` at the coarser levels,
    /// whose stacks begin as `coarse` says.
    pub(crate) fn zeros(
        inputs: usize,
        conditions: usize,
        widths: [usize; LEVELS],
        coarse: CoarseEntry,
        device: &Device,
    ) -> Self {
        let stack = |inputs: usize, level: usize| {
            let stack = ResidualStack::zeros([inputs, widths[level]], 1, device);
            if level > 0 && coarse == CoarseEntry::Linear {
                stack.with_linear_entry()
            } else {
                stack
            }
        };
        let encoder = |level: usize| {
            stack(if level == 0 { inputs } else { widths[level - 1] + conditions }, level)
        };
        let up =
            |level: usize| Conv2d::zeros([widths[level + 1], 4 * HANDED_UP], 1, Bias::Yes, device);
        let decoder = |level: usize| stack(widths[level] + HANDED_UP, level);
        Self {
            encoder: (0..LEVELS).map(encoder).collect(),
            up: (0..LEVELS - 1).map(up).collect(),
            decoder: (0..LEVELS - 1).map(decoder).collect(),
        }
    }

    /// Computes the features of all levels.
    ///
    /// # Shapes
    /// - inputs: `[images, channels, h, w]` each
    /// - conditions: `[images, planes, 1, 1]`, the same at every place of the coarser levels
    pub(crate) fn forward(&self, inputs: &[Tensor<4>], conditions: Option<&Tensor<4>>) -> Pyramid {
        let finest = self.encoder[0].forward(inputs);
        let coarser = |level: usize, finer: &Tensor<4>| {
            let pooled = avg_pool2(finer.clone());
            let [images, _, h, w] = pooled.dims();
            let mut inputs = vec![pooled];
            inputs.extend(conditions.map(|c| c.clone().expand([images, c.dims()[1], h, w])));
            self.encoder[level].forward(&inputs)
        };
        let middle = coarser(1, &finest);
        let coarsest = coarser(2, &middle);
        let finer = |level: usize, skip: Tensor<4>, coarser: &Tensor<4>| {
            let up = self.up[level].linear(std::slice::from_ref(coarser));
            self.decoder[level].forward(&[skip, pixel_shuffle(up, 2)])
        };
        let middle = finer(1, middle, &coarsest);
        let finest = finer(0, finest, &middle);
        [finest, middle, coarsest]
    }
}

/// An image from features: pixels first, then a convolution, which leaves no grid.
#[derive(Module, Debug)]
pub(super) struct ImageHead {
    out: Conv2d,
}

impl ImageHead {
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        Self { out: Conv2d::zeros([features / 4, 1], 3, Bias::Yes, device) }
    }

    /// Computes an image, `[images, 1, 2 h, 2 w]`, from features, `[images, features, h, w]`.
    pub(super) fn forward(&self, features: Tensor<4>) -> Tensor<4> {
        self.out.linear(&[pixel_shuffle(features, 2)])
    }
}

/// Scales the channels of every pixel to a root mean square of about one. Small ones stay small.
pub(super) fn normalized(x: Tensor<4>) -> Tensor<4> {
    /// Added to the mean square.
    const FLOOR: f32 = 0.05;
    pixel_norm(x, FLOOR)
}
