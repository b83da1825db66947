//! A pre-denoiser: a residual dense network (Zhang et al. 2018) that corrects the reference estimate frame by
//! frame.

use super::CORRECTION;
use super::config::RegressionConfig;
use super::input::NormalizedInput;
use super::neighbour_weighting::NeighbourWeighting;
use crate::aligned::{Aligned, AlignedNeighbours};
use crate::residual_dense;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d, DenseBlock};

/// Number of planes that the images of an aligned frame become.
const IMAGE_PLANES: usize = 4;

/// A pre-denoiser.
#[derive(Module, Debug)]
pub struct PreDenoiser {
    static_in: Conv2d,
    weighting: NeighbourWeighting,
    weighted_in: Conv2d,
    blocks: Vec<DenseBlock>,
    gather: Conv2d,
    spread: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl RegressionConfig {
    /// Creates a pre-denoiser that sees these neighbours, all weights zero.
    pub(crate) fn init_predenoiser(
        &self,
        neighbours: AlignedNeighbours,
        device: &Device,
    ) -> PreDenoiser {
        let (width, planes) = (self.width, self.fold * self.fold);
        let inputs = IMAGE_PLANES + neighbours.standardized_planes();
        let conv = |sizes, kernel, bias| Conv2d::zeros(sizes, kernel, bias, device);
        let block = |_| DenseBlock::zeros(width, self.growth, device);
        PreDenoiser {
            static_in: conv([inputs * planes, width], 3, Bias::Yes),
            weighting: self.init_weighting(device),
            weighted_in: conv([self.weighting_channels(), width], 3, Bias::No),
            blocks: (0..self.blocks).map(block).collect(),
            gather: conv([self.blocks * width, width], 1, Bias::Yes),
            spread: conv([width, width], 3, Bias::Yes),
            out: conv([width, planes], 3, Bias::Yes),
            fold: self.fold,
        }
    }
}

impl PreDenoiser {
    /// Pre-denoises frames, in image units.
    ///
    /// # Shapes
    /// - result: `[images, 1, height, width]`
    pub fn predenoise(&self, aligned: &Aligned<Tensor<4>>) -> Tensor<4> {
        self.forward(&NormalizedInput::new(aligned)).0
    }

    /// Corrects the reference estimate: the frames in image units, `[images, 1, H, W]`, and features
    /// `[images, width, h, w]`.
    pub(crate) fn forward(&self, input: &NormalizedInput) -> (Tensor<4>, Tensor<4>) {
        let planes = pixel_unshuffle(input.planes.clone(), self.fold);
        let encoded = self.static_in.linear(std::slice::from_ref(&planes));
        let shallow = self.weighted_in.add(&[self.weighting.forward(&planes)], encoded);
        let features = residual_dense::features(shallow, &self.blocks, &self.gather, &self.spread);
        let correction = pixel_shuffle(self.out.linear(std::slice::from_ref(&features)), self.fold);
        let correction = correction * input.sigma.clone() * CORRECTION;
        (input.reference.clone() + correction, features)
    }
}
