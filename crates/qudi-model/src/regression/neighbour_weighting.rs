//! Robustness weights: how much each aligned neighbour counts at every pixel.
//!
//! A layer that sees all neighbours at once can only add them up; whether one of them shows the same thing is
//! a question to each of them.

use super::config::RegressionConfig;
use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d};

/// The planes of a frame that decide together with a neighbour's two.
const FRAME_PLANES: usize = 5;

/// Weights every aligned neighbour pixel by pixel and merges their counts.
#[derive(Module, Debug)]
pub(super) struct NeighbourWeighting {
    around: Conv2d,
    neighbour: Conv2d,
    inner: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl RegressionConfig {
    /// Creates the layers that weight neighbours, all weights zero.
    pub(super) fn init_weighting(&self, device: &Device) -> NeighbourWeighting {
        let (width, planes) = (self.weight_channels, self.fold * self.fold);
        let conv = |sizes, bias| Conv2d::zeros(sizes, 3, bias, device);
        NeighbourWeighting {
            around: conv([FRAME_PLANES * planes, width], Bias::Yes),
            neighbour: conv([2 * planes, width], Bias::No),
            inner: conv([width, width], Bias::Yes),
            out: conv([width, planes], Bias::Yes),
            fold: self.fold,
        }
    }

    /// Returns the number of channels that the weighting gives.
    pub(super) fn weighting_channels(&self) -> usize {
        2 * self.fold * self.fold + self.weight_channels
    }
}

impl NeighbourWeighting {
    /// Merges the counts of a frame and of its neighbours by their weights.
    ///
    /// The result has the merged counts in sigmas, the logarithm of how many frames they stand for, and
    /// features that the neighbours have in common.
    ///
    /// # Shapes
    /// - planes: `[images, (5 + 2 K) * fold^2, h, w]`: the planes of the frame alone, its counts last, then
    ///   the counts of `K` neighbours and what is expected of them
    /// - result: `[images, 2 fold^2 + width, h, w]`
    pub(super) fn forward(&self, planes: &Tensor<4>) -> Tensor<4> {
        let cells = self.fold * self.fold;
        let plane = |at| planes.clone().narrow(1, at * cells, cells);
        let own = plane(FRAME_PLANES - 1);
        let around = self.around.linear(&[planes.clone().narrow(1, 0, FRAME_PLANES * cells)]);
        let neighbours = (planes.dims()[1] / cells - FRAME_PLANES) / 2;
        let mut merged = own.clone();
        let mut frames = own.ones_like();
        let mut noise = own.ones_like();
        let mut common = around.zeros_like();
        for k in 0..neighbours {
            let [counts, expected] = [k, neighbours + k].map(|k| plane(FRAME_PLANES + k));
            let features = self.neighbour.add_relu(&[counts.clone(), expected], around.clone());
            let features = self.inner.relu(&[features]);
            let weight = sigmoid(self.out.linear(std::slice::from_ref(&features)));
            merged = merged + weight.clone() * counts;
            noise = noise + weight.clone() * weight.clone();
            frames = frames + weight;
            common = common + features;
        }
        let common = common / neighbours as f32;
        Tensor::cat(vec![merged / noise.sqrt(), frames.log(), common], 1)
    }
}
