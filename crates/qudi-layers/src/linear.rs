//! Linear layer: a matrix and a bias.

use super::parameters::zeros;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use qudi_kernels::conv::{Options, conv_2d};

/// A linear layer: a matrix and a bias.
#[derive(Module, Debug)]
pub struct Linear {
    /// `[outputs, inputs]`
    weight: Param<Tensor<2>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
}

impl Linear {
    /// Creates a layer of zeros.
    pub fn zeros([inputs, outputs]: [usize; 2], device: &Device) -> Self {
        Self { weight: zeros([outputs, inputs], device), bias: zeros([outputs], device) }
    }

    /// Applies the layer to the channels of every pixel.
    ///
    /// # Shapes
    /// - x: `[images, inputs, height, width]`
    /// - result: `[images, outputs, height, width]`
    pub fn on_channels(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        let [outputs, inputs] = weight.dims();
        let weight = weight.reshape([outputs, inputs, 1, 1]);
        conv_2d(&[x], weight, self.bias.val(), Options::default())
    }

    /// Applies the layer to rows.
    ///
    /// # Shapes
    /// - x: `[rows, inputs]`
    /// - result: `[rows, outputs]`
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.weight.val().transpose()) + self.bias.val().unsqueeze()
    }
}
