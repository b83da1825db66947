//! The recurrent cell, from the first frame to the last.

use super::alignment::smaller;
use crate::parts::renamed;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, DenseBlock};
use std::slice::from_ref;

/// Maps of a frame at three scales, the finest first.
pub(super) type Maps = [Tensor<4>; 3];

/// The cell.
#[derive(Module, Debug)]
#[allow(clippy::struct_field_names)] // as in the authors' files
pub(super) struct Cell {
    f_b01: Conv2d,
    f_b01_fuse: Conv2d,
    f_b02: Conv2d,
    f_b03: Conv2d,
    f_b1: Down,
    f_b2: Down,
    f_r0: Shrink,
    f_r1: Chain,
    f_h0: Conv2d,
    f_h1: DenseBlock,
    f_h2: Conv2d,
}

/// A dense block, then half the size.
#[derive(Module, Debug)]
struct Down {
    rdb: DenseBlock,
    down_sampling: Conv2d,
}

/// A dense block, then fewer channels.
#[derive(Module, Debug)]
struct Shrink {
    rdb: DenseBlock,
    shrink: Conv2d,
}

/// Dense blocks, and all that they gave together.
#[derive(Module, Debug)]
struct Chain {
    rdbs: Vec<DenseBlock>,
    conv1x1: Conv2d,
    conv3x3: Conv2d,
}

impl Cell {
    pub(super) fn zeros(features: usize, blocks: usize, device: &Device) -> Self {
        let n = features;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let dense = |width, growth| DenseBlock::zeros(width, growth, device);
        let down = |width, growth| Down {
            rdb: dense(width, growth),
            down_sampling: conv([width, 4 * n], 5),
        };
        Self {
            f_b01: conv([1, n], 5),
            f_b01_fuse: conv([2 * n, 4 * n], 1),
            f_b02: conv([1, n], 3),
            f_b03: conv([1, n], 3),
            f_b1: down(4 * n, n),
            f_b2: down(6 * n, 3 * n / 2),
            f_r0: Shrink { rdb: dense(8 * n, n), shrink: conv([8 * n, 4 * n], 3) },
            f_r1: Chain {
                rdbs: (1..blocks).map(|_| dense(4 * n, 2 * n)).collect(),
                conv1x1: conv([(blocks - 1) * 4 * n, 4 * n], 1),
                conv3x3: conv([4 * n, 4 * n], 3),
            },
            f_h0: conv([4 * n, 2 * n], 3),
            f_h1: dense(2 * n, 2 * n),
            f_h2: conv([2 * n, 2 * n], 3),
        }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let pairs = [
            (".f_b", ".F_B"),
            (".f_r0.", ".F_R.0."),
            (".f_r1.rdbs.", ".F_R.1.RDBs."),
            (".f_r1.", ".F_R.1."),
            (".f_h0.", ".F_h.0."),
            (".f_h1.", ".F_h.1."),
            (".f_h2.", ".F_h.2."),
        ];
        renamed(name, &pairs)
    }

    /// Computes the maps of a frame and the next state. `fused` are aligned features at three scales, the
    /// finest first.
    pub(super) fn forward(
        &self,
        x: &Tensor<4>,
        mut fused: impl Iterator<Item = Tensor<4>>,
        state: Tensor<4>,
    ) -> (Maps, Tensor<4>) {
        let mut next = || fused.next().expect("three scales");
        let [half, quarter] = smaller(x);
        let h1 = self.f_b01_fuse.linear(&[self.f_b01.linear(from_ref(x)), next()]);
        let h2 = self.f_b1.forward(h1.clone());
        let h3 = Tensor::cat(vec![h2.clone(), self.f_b02.linear(&[half]), next()], 1);
        let h3 = self.f_b2.forward(h3);
        let h3 = Tensor::cat(vec![h3, self.f_b03.linear(&[quarter]), next(), state], 1);
        let h3 = self.f_r0.shrink.linear(&[self.f_r0.rdb.forward_gelu(h3)]);
        let h3 = self.f_r1.forward(h3);
        let state = self.f_h1.forward_gelu(self.f_h0.linear(from_ref(&h3)));
        ([h1, h2, h3], self.f_h2.linear(&[state]))
    }
}

impl Down {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.down_sampling.stride2(&[self.rdb.forward_gelu(x)])
    }
}

impl Chain {
    fn forward(&self, mut x: Tensor<4>) -> Tensor<4> {
        let mut outputs = Vec::with_capacity(self.rdbs.len());
        for block in &self.rdbs {
            x = block.forward_gelu(x);
            outputs.push(x.clone());
        }
        self.conv3x3.linear(&[self.conv1x1.linear(&outputs)])
    }
}
