//! Residual blocks, and dense blocks that halve the size.

use crate::parts::{Residual, leaky, renamed};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, DenseBlock};

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
        let block = |_| Residual::zeros(features, Bias::Yes, device);
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
            Some(entry) => leaky(entry.linear(inputs)),
            None => inputs[0].clone(),
        };
        self.blocks.iter().fold(x, |x, block| block.forward(x))
    }
}
