//! The transposed convolution that doubles the size.

use burn::module::{Module, Param};
use burn::tensor::module::conv_transpose2d;
use burn::tensor::ops::ConvTransposeOptions;
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;

/// A transposed convolution of 3 x 3 and stride 2.
#[derive(Module, Debug)]
pub struct ConvTranspose {
    /// `[inputs, outputs, 3, 3]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
}

impl ConvTranspose {
    /// The layer, all weights zero.
    pub fn zeros([inputs, outputs]: [usize; 2], device: &Device) -> Self {
        Self { weight: zeros([inputs, outputs, 3, 3], device), bias: zeros([outputs], device) }
    }

    /// Twice the size.
    ///
    /// # Shapes
    /// - x: `[images, inputs, height, width]`
    /// - result: `[images, outputs, 2 * height, 2 * width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let options = ConvTransposeOptions::new([2, 2], [1, 1], [1, 1], [1, 1], 1);
        conv_transpose2d(x, self.weight.val(), Some(self.bias.val()), options)
    }
}
