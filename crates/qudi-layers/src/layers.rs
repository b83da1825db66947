//! Convolutions one after the other.

use super::{Bias, Conv2d};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// Convolutions one after the other, each but the last followed by ReLU.
#[derive(Module, Debug)]
pub struct Layers {
    layers: Vec<Conv2d>,
}

impl Layers {
    /// Layers of these inputs and outputs, all weights zero.
    pub fn zeros(sizes: &[[usize; 2]], kernel: usize, device: &Device) -> Self {
        let layer = |&sizes| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        Self { layers: sizes.iter().map(layer).collect() }
    }

    /// What the last layer gives. `inputs` are joined by channel, `[images, channels, height, width]`.
    ///
    /// # Panics
    /// Without layers.
    pub fn forward(&self, mut inputs: Vec<Tensor<4>>) -> Tensor<4> {
        let (last, first) = self.layers.split_last().expect("a layer");
        for layer in first {
            inputs = vec![layer.relu(&inputs)];
        }
        last.linear(&inputs)
    }
}
