//! The pre-denoiser: a residual dense network (Zhang et al. 2018) that corrects the linear estimate frame by
//! frame.

use super::input::NormalizedInput;
use crate::diffusion::PreConfig;
use crate::residual_dense;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d, DenseBlock};

/// Number of planes of a frame: linear estimate, counts, noise.
const PLANES: usize = 3;

/// The pre-denoiser.
#[derive(Module, Debug)]
pub(crate) struct PreDenoiser {
    static_in: Conv2d,
    simulated_in: Conv2d,
    blocks: Vec<DenseBlock>,
    gather: Conv2d,
    spread: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl PreConfig {
    /// Creates the pre-denoiser on planes whose squares of `fold` pixels are channels, all weights zero.
    pub(crate) fn init(&self, fold: usize, device: &Device) -> PreDenoiser {
        let (width, planes) = (self.width, fold * fold);
        let conv = |sizes, kernel, bias| Conv2d::zeros(sizes, kernel, bias, device);
        let block = |_| DenseBlock::zeros(width, self.growth, device);
        PreDenoiser {
            static_in: conv([PLANES * planes, width], 3, Bias::Yes),
            simulated_in: conv([2 * planes + 1, width], 3, Bias::No),
            blocks: (0..self.blocks).map(block).collect(),
            gather: conv([self.blocks * width, width], 1, Bias::Yes),
            spread: conv([width, width], 3, Bias::Yes),
            out: conv([width, planes], 3, Bias::Yes),
            fold,
        }
    }
}

impl PreDenoiser {
    /// Encodes what does not depend on the step, `[images, width, h, w]`.
    pub(crate) fn encode(&self, input: &NormalizedInput) -> Tensor<4> {
        self.static_in.linear(&[pixel_unshuffle(input.planes.clone(), self.fold)])
    }

    /// Corrects the linear estimate: the frames in image units, `[images, 1, H, W]`, and features `[images,
    /// width, h, w]`. `encoded` is [`Self::encode`] of the same `input`; `simulated` are `y_sim` and `u_sim`;
    /// `flag` is one for images that have them, else zero, `[images, 1, 1, 1]`.
    pub(crate) fn forward(
        &self,
        encoded: Tensor<4>,
        input: &NormalizedInput,
        simulated: Tensor<4>,
        flag: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let [images, _, h, w] = encoded.dims();
        let inputs = [pixel_unshuffle(simulated, self.fold), flag.expand([images, 1, h, w])];
        let shallow = self.simulated_in.add(&inputs, encoded);
        let features = residual_dense::features(shallow, &self.blocks, &self.gather, &self.spread);
        let correction = pixel_shuffle(self.out.linear(std::slice::from_ref(&features)), self.fold);
        (input.linear_estimate.clone() + correction * input.sigma.clone(), features)
    }
}
