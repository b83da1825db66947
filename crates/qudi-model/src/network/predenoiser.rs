//! The pre-denoiser: a residual dense network (Zhang et al. 2018) that corrects the reference estimate frame
//! by frame.

use super::neighbour_weighting::NeighbourWeighting;
use super::normalized_input::NormalizedInput;
use crate::conditioning::AlignedTensors;
use crate::config::{PreConfig, ReferenceKind};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::DenseBlock;
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d};

/// The planes that the images of an aligned frame become.
const IMAGE_PLANES: usize = 4;

/// The planes of a frame without reference estimate: linear estimate, counts, noise.
const SINGLE_IMAGE_PLANES: usize = 3;

/// The pre-denoiser.
#[derive(Module, Debug)]
pub struct PreDenoiser {
    static_in: Conv2d,
    weighting: Option<NeighbourWeighting>,
    weighted_in: Option<Conv2d>,
    simulated_in: Conv2d,
    blocks: Vec<DenseBlock>,
    gather: Conv2d,
    spread: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl PreConfig {
    /// The pre-denoiser on planes whose squares of `fold` pixels are channels, all weights zero.
    pub fn init(&self, reference: ReferenceKind, fold: usize, device: &Device) -> PreDenoiser {
        let (width, planes) = (self.width, fold * fold);
        let inputs = match reference {
            ReferenceKind::None => SINGLE_IMAGE_PLANES,
            ReferenceKind::QbpRefined => {
                IMAGE_PLANES + self.aligned_neighbours().standardized_planes()
            }
        };
        let conv = |sizes, kernel, bias| Conv2d::zeros(sizes, kernel, bias, device);
        let block = |_| DenseBlock::zeros(width, self.growth, device);
        let weighted = self.weighting_channels(fold);
        PreDenoiser {
            static_in: conv([inputs * planes, width], 3, Bias::Yes),
            weighting: self.init_weighting(fold, device),
            weighted_in: (self.weight_channels > 0).then(|| conv([weighted, width], 3, Bias::No)),
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
    /// Adds inputs for `more` aligned neighbours after those that it has: of zero weight in the first layer,
    /// weighted by [`NeighbourWeighting`] like the others.
    pub(super) fn with_more_neighbours(self, more: usize) -> Self {
        let planes = self.fold * self.fold;
        let inputs = self.static_in.inputs();
        let neighbours = (inputs / planes - IMAGE_PLANES - 1) / 2;
        let more = more * planes;
        // Expectations come last.
        let static_in = self.static_in.with_zero_inputs(inputs, more);
        let static_in = static_in.with_zero_inputs(inputs - neighbours * planes, more);
        Self { static_in, ..self }
    }

    /// Encodes what does not depend on the step, `[images, width, h, w]`.
    pub(super) fn encode(&self, input: &NormalizedInput) -> Tensor<4> {
        let planes = pixel_unshuffle(input.planes.clone(), self.fold);
        let encoded = self.static_in.linear(std::slice::from_ref(&planes));
        match (&self.weighting, &self.weighted_in) {
            (Some(weighting), Some(weighted_in)) => {
                weighted_in.add(&[weighting.forward(&planes)], encoded)
            }
            _ => encoded,
        }
    }

    /// Pre-denoises frames before any simulated measurement, in image units.
    ///
    /// # Shapes
    /// - result: `[images, 1, height, width]`
    pub fn predenoise(&self, aligned: &AlignedTensors) -> Tensor<4> {
        self.predenoise_normalized(&NormalizedInput::aligned(aligned)).0
    }

    /// [`Self::predenoise`] of normalized inputs, with the features.
    pub(super) fn predenoise_normalized(&self, input: &NormalizedInput) -> (Tensor<4>, Tensor<4>) {
        let nothing = input.start.zeros_like().repeat_dim(1, 2);
        let flag = nothing.clone().narrow(1, 0, 1).narrow(2, 0, 1).narrow(3, 0, 1);
        self.forward(self.encode(input), input, nothing, flag)
    }

    /// Corrects what `input` starts from: the frames in image units, `[images, 1, H, W]`, and features
    /// `[images, width, h, w]`. `encoded` is [`Self::encode`] of the same `input`; `simulated` are `y_sim`
    /// and `u_sim`; `flag` says of every image whether they exist, `[images, 1, 1, 1]`.
    pub(super) fn forward(
        &self,
        encoded: Tensor<4>,
        input: &NormalizedInput,
        simulated: Tensor<4>,
        flag: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let [images, _, h, w] = encoded.dims();
        let inputs = [pixel_unshuffle(simulated, self.fold), flag.expand([images, 1, h, w])];
        let shallow = self.simulated_in.add(&inputs, encoded);
        let mut x = shallow.clone();
        let mut outputs = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            x = block.forward(x);
            outputs.push(x.clone());
        }
        let features = self.spread.add(&[self.gather.linear(&outputs)], shallow);
        let correction = pixel_shuffle(self.out.linear(std::slice::from_ref(&features)), self.fold);
        let correction = correction * input.sigma.clone() * input.correction;
        (input.start.clone() + correction, features)
    }
}
