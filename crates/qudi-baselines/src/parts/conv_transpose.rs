//! Transposed convolutions that double the size.

use burn::module::{Module, Param};
use burn::tensor::module::conv_transpose2d;
use burn::tensor::ops::ConvTransposeOptions;
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;

/// A transposed convolution of stride 2, of 3 x 3 or 4 x 4.
#[derive(Module, Debug)]
pub struct ConvTranspose {
    /// `[inputs, outputs, kernel, kernel]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
}

impl ConvTranspose {
    /// Makes the layer, all weights zero. The kernel is 3 or 4.
    pub fn zeros([inputs, outputs]: [usize; 2], kernel: usize, device: &Device) -> Self {
        Self {
            weight: zeros([inputs, outputs, kernel, kernel], device),
            bias: zeros([outputs], device),
        }
    }

    /// Applies the layer, which doubles the size.
    ///
    /// # Shapes
    /// - x: `[images, inputs, height, width]`
    /// - result: `[images, outputs, 2 * height, 2 * width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        // A kernel of 3 lacks a row and a column.
        let more = 4 - weight.dims()[2];
        let options = ConvTransposeOptions::new([2, 2], [1, 1], [more, more], [1, 1], 1);
        conv_transpose2d(x, weight, Some(self.bias.val()), options)
    }
}
