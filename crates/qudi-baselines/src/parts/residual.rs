//! The residual block.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d};
use std::slice::from_ref;

/// Two convolutions of 3 x 3 with ReLU between them, and a residual.
#[derive(Module, Debug)]
pub struct Residual {
    conv1: Conv2d,
    conv2: Conv2d,
}

impl Residual {
    /// Makes the block, all weights zero.
    pub fn zeros(channels: usize, bias: Bias, device: &Device) -> Self {
        let conv = || Conv2d::zeros([channels, channels], 3, bias, device);
        Self { conv1: conv(), conv2: conv() }
    }

    /// Adds the output of the layers to `x`.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.conv2.add(&[self.conv1.relu(from_ref(&x))], x)
    }
}
