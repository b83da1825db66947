//! Residual dense block (Zhang et al. 2018, section 3.3).

use super::{Bias, Conv2d};
use burn::module::Module;
use burn::tensor::activation::gelu;
use burn::tensor::{Device, Tensor};

/// Number of dense layers in a block.
const LAYERS: usize = 3;

/// Residual block of layers that each take the outputs of all previous layers.
#[derive(Module, Debug)]
pub struct DenseBlock {
    layers: Vec<Conv2d>,
    fuse: Conv2d,
}

impl DenseBlock {
    /// Creates a block of zeros.
    pub fn zeros(width: usize, growth: usize, device: &Device) -> Self {
        let layer = |l| Conv2d::zeros([width + l * growth, growth], 3, Bias::Yes, device);
        let all = width + LAYERS * growth;
        Self {
            layers: (0..LAYERS).map(layer).collect(),
            fuse: Conv2d::zeros([all, width], 1, Bias::Yes, device),
        }
    }

    /// Applies the block with ReLU after each layer, and adds `x`.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.through(x, Conv2d::relu)
    }

    /// Applies the block with GELU after each layer, and adds `x`.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub fn forward_gelu(&self, x: Tensor<4>) -> Tensor<4> {
        self.through(x, |layer, parts| gelu(layer.linear(parts)))
    }

    fn through(
        &self,
        x: Tensor<4>,
        layer: impl Fn(&Conv2d, &[Tensor<4>]) -> Tensor<4>,
    ) -> Tensor<4> {
        let mut parts = vec![x.clone()];
        for weights in &self.layers {
            parts.push(layer(weights, &parts));
        }
        self.fuse.add(&parts, x)
    }
}
