//! The denoising of single frames.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, DenseBlock};
use std::slice::from_ref;

/// Channels that each layer of the dense block adds.
const GROWTH: usize = 64;

/// Number of times that the dense block is applied.
const BLOCKS: usize = 5;

/// A residual dense network whose blocks are one and the same.
#[derive(Module, Debug)]
pub(super) struct PreDenoiser {
    sfe1: Conv2d,
    sfe2: Conv2d,
    rdb: DenseBlock,
    gff0: Conv2d,
    gff1: Conv2d,
    out: Conv2d,
}

impl PreDenoiser {
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        Self {
            sfe1: conv([1, features], 1),
            sfe2: conv([features, features], 3),
            rdb: DenseBlock::zeros(features, GROWTH, device),
            gff0: conv([BLOCKS * features, features], 1),
            gff1: conv([features, features], 3),
            out: conv([features, 1], 3),
        }
    }

    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let shallow = self.sfe1.linear(from_ref(&x));
        let mut f = self.sfe2.linear(from_ref(&shallow));
        let mut outputs = Vec::with_capacity(BLOCKS);
        for _ in 0..BLOCKS {
            f = self.rdb.forward(f);
            outputs.push(f.clone());
        }
        let deep = self.gff1.add(&[self.gff0.linear(&outputs)], shallow);
        self.out.add(&[deep], x)
    }
}
