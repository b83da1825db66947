//! How far each neighbour is to be trusted, pixel by pixel. A layer that sees all neighbours at once can only add them up; which of
//! them shows the same thing is a question to each of them.

use super::layers::{Bias, Conv2d};
use crate::config::PreConfig;
use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};

/// Planes of a frame that decide together with a neighbour's two.
const FRAME: usize = 5;

/// See the module.
#[derive(Module, Debug)]
pub(super) struct Trust {
    around: Conv2d,
    neighbour: Conv2d,
    inner: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl PreConfig {
    /// The layers that weigh neighbours, weights zero, if there are any.
    pub(super) fn init_trust(&self, fold: usize, device: &Device) -> Option<Trust> {
        let (width, planes) = (self.trust, fold * fold);
        let conv = |sizes, bias| Conv2d::zeros(sizes, 3, bias, device);
        (width > 0).then(|| Trust {
            around: conv([FRAME * planes, width], Bias::Yes),
            neighbour: conv([2 * planes, width], Bias::No),
            inner: conv([width, width], Bias::Yes),
            out: conv([width, planes], Bias::Yes),
            fold,
        })
    }

    /// Channels of what they say.
    pub(super) fn trusted(&self, fold: usize) -> usize {
        2 * fold * fold + self.trust
    }
}

impl Trust {
    /// The counts of a frame and of its neighbours, weighed and merged, in deviations; the logarithm of how many they are; and
    /// what the neighbours have in common. `planes`, folded: those of the frame alone, its counts last, then the counts of `K`
    /// neighbours and what is expected of them, `[images, (FRAME + 2 K) * fold^2, h, w]`; result `[images, 2 fold^2 + width, h, w]`.
    pub(super) fn forward(&self, planes: &Tensor<4>) -> Tensor<4> {
        let cells = self.fold * self.fold;
        let plane = |at| planes.clone().narrow(1, at * cells, cells);
        let own = plane(FRAME - 1);
        let around = self.around.linear(&[planes.clone().narrow(1, 0, FRAME * cells)]);
        let neighbours = (planes.dims()[1] / cells - FRAME) / 2;
        let mut merged = own.clone();
        let mut frames = own.ones_like();
        let mut noise = own.ones_like();
        let mut common = around.zeros_like();
        for k in 0..neighbours {
            let [seen, expected] = [k, neighbours + k].map(|k| plane(FRAME + k));
            let told = self.neighbour.add_relu(&[seen.clone(), expected], around.clone());
            let told = self.inner.relu(&[told]);
            let weight = sigmoid(self.out.linear(std::slice::from_ref(&told)));
            merged = merged + weight.clone() * seen;
            noise = noise + weight.clone() * weight.clone();
            frames = frames + weight;
            common = common + told;
        }
        let common = common / neighbours.max(1) as f32;
        Tensor::cat(vec![merged / noise.sqrt(), frames.log(), common], 1)
    }
}
