//! Sequence of convolutions.

use super::{Bias, Conv2d};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// A sequence of convolutions, each but the last followed by ReLU.
#[derive(Module, Debug)]
pub struct Layers {
    layers: Vec<Conv2d>,
}

impl Layers {
    /// Creates layers of zeros with the given numbers of inputs and outputs.
    pub fn zeros(sizes: &[[usize; 2]], kernel: usize, device: &Device) -> Self {
        let layer = |&sizes| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        Self { layers: sizes.iter().map(layer).collect() }
    }

    /// Applies all layers to `inputs`, `[images, channels, height, width]`, joined by channel.
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
