//! The convolution of every channel by itself.

use burn::module::{Module, Param};
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;

/// A convolution of 3 x 3 of every channel by itself, without bias.
#[derive(Module, Debug)]
pub struct Depthwise {
    /// `[channels, 1, 3, 3]`
    weight: Param<Tensor<4>>,
}

impl Depthwise {
    /// Makes the layer, all weights zero.
    pub fn zeros(channels: usize, device: &Device) -> Self {
        Self { weight: zeros([channels, 1, 3, 3], device) }
    }

    /// Applies the layer: sums over nine pixels, zeros outside.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, channels, height, width] = x.dims();
        let padded = x.pad([(0, 0), (0, 0), (1, 1), (1, 1)], PadMode::Constant(0.0));
        let weight = self.weight.val().reshape([1, channels, 9, 1]);
        let tap = |tap: usize| {
            let pixels = padded.clone().narrow(2, tap / 3, height).narrow(3, tap % 3, width);
            pixels * weight.clone().narrow(2, tap, 1)
        };
        (1..9).fold(tap(0), |sum, k| sum + tap(k))
    }
}
