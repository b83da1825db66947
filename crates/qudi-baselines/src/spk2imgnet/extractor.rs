//! Features of a block of frames.

use super::{BLOCK, Sizes, conv};
use crate::parts::renamed;
use burn::module::Module;
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::{Device, Tensor};
use qudi_layers::Conv2d;
use std::slice::from_ref;

/// Stems, each of which estimates the image.
const STEMS: usize = 4;

/// Estimates of a block, and features of them.
#[derive(Module, Debug)]
pub(super) struct Extractor {
    conv0: Vec<Conv2d>,
    conv1: Vec<Conv2d>,
    ca: Attention,
    conv: Conv2d,
    net: Vec<Block>,
}

/// Weights of estimates.
#[derive(Module, Debug)]
struct Attention {
    first: Conv2d,
    second: Conv2d,
}

/// Three convolutions and a residual.
#[derive(Module, Debug)]
struct Block {
    conv1: Conv2d,
    conv2: Conv2d,
    conv3: Conv2d,
}

impl Extractor {
    pub(super) fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { features, stem, blocks, .. } = sizes;
        let same = || conv([features, features], device);
        let stems = |sizes: [usize; 2]| (0..STEMS).map(|_| conv(sizes, device)).collect();
        Self {
            conv0: stems([BLOCK, stem]),
            conv1: stems([stem, 1]),
            ca: Attention {
                first: conv([STEMS, 2 * STEMS], device),
                second: conv([2 * STEMS, STEMS], device),
            },
            conv: conv([STEMS, features], device),
            net: (0..blocks)
                .map(|_| Block { conv1: same(), conv2: same(), conv3: same() })
                .collect(),
        }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let pairs = [
            ("extractor.conv0.", "extractor.conv0_"),
            ("extractor.conv1.", "extractor.conv1_"),
            ("ca.first.", "ca.ca_block.0."),
            ("ca.second.", "ca.ca_block.2."),
        ];
        renamed(name, &pairs)
    }

    /// Computes four estimates of every block, and its features.
    pub(super) fn forward(&self, blocks: Tensor<4>) -> (Tensor<4>, Tensor<4>) {
        let stems = self.conv0.iter().zip(&self.conv1);
        let estimate =
            |(first, second): (&Conv2d, &Conv2d)| second.linear(&[first.relu(from_ref(&blocks))]);
        let estimates = Tensor::cat(stems.map(estimate).collect(), 1);
        let weight = self.ca.first.relu(from_ref(&estimates));
        let weight = sigmoid(self.ca.second.linear(&[weight]));
        let features = self.conv.relu(&[weight * estimates.clone()]);
        let deep = self.net.iter().fold(features.clone(), |x, block| {
            let inner = block.conv2.relu(&[block.conv1.relu(from_ref(&x))]);
            relu(block.conv3.add(&[inner], x))
        });
        (estimates, features + deep)
    }
}
