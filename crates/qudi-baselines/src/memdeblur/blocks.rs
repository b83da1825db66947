//! Residual blocks, and dense blocks that halve the size.

use crate::parts::renamed;
use burn::module::Module;
use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, DenseBlock};
use std::slice::from_ref;

/// A dense block, then half the size and four times the channels.
#[derive(Module, Debug)]
pub(super) struct Down {
    rdb: DenseBlock,
    down_sampling: Conv2d,
}

/// Residual blocks, after a convolution where they begin from other channels.
#[derive(Module, Debug)]
pub(super) struct Residuals {
    entry: Option<Conv2d>,
    blocks: Vec<Residual>,
}

/// Two convolutions and a residual.
#[derive(Module, Debug)]
struct Residual {
    conv1: Conv2d,
    conv2: Conv2d,
}

impl Down {
    pub(super) fn zeros(channels: usize, growth: usize, device: &Device) -> Self {
        Self {
            rdb: DenseBlock::zeros(channels, growth, device),
            down_sampling: Conv2d::zeros([channels, 4 * channels], 5, Bias::Yes, device),
        }
    }

    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.down_sampling.stride2(&[self.rdb.forward(x)])
    }
}

impl Residuals {
    pub(super) fn zeros(
        inputs: Option<usize>,
        features: usize,
        blocks: usize,
        device: &Device,
    ) -> Self {
        let conv = |inputs| Conv2d::zeros([inputs, features], 3, Bias::Yes, device);
        let block = |_| Residual { conv1: conv(features), conv2: conv(features) };
        Self { entry: inputs.map(conv), blocks: (0..blocks).map(block).collect() }
    }

    pub(super) fn authors_name(name: &str) -> String {
        // Without a convolution before them, the blocks are the first part.
        let blocks = if name.starts_with("forward_resblocks.") { "main.0." } else { "main.2." };
        let pairs =
            [("resblocks.entry.", "resblocks.main.0."), ("resblocks.blocks.", "resblocks.BLOCKS.")];
        renamed(name, &pairs).replace("BLOCKS.", blocks)
    }

    pub(super) fn forward(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        let x = match &self.entry {
            Some(entry) => leaky_relu(entry.linear(inputs), 0.1),
            None => inputs[0].clone(),
        };
        self.blocks.iter().fold(x, |x, block| block.conv2.add(&[block.conv1.relu(from_ref(&x))], x))
    }
}
