//! Normalisation of the channels of every pixel.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;

/// Term added to the variance.
const EPSILON: f32 = 1e-5;

/// Channels of every pixel less their mean, over their standard deviation, times a weight and plus a bias.
#[derive(Module, Debug)]
pub struct LayerNorm {
    /// `[channels]`
    weight: Param<Tensor<1>>,
    /// `[channels]`
    bias: Param<Tensor<1>>,
}

impl LayerNorm {
    /// Makes the norm, weights zero.
    pub fn zeros(channels: usize, device: &Device) -> Self {
        Self { weight: zeros([channels], device), bias: zeros([channels], device) }
    }

    /// Normalises channels.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let channels = x.dims()[1];
        let centred = x.clone() - x.mean_dim(1);
        let variance = centred.clone().powi_scalar(2).mean_dim(1);
        let of_channels = |values: &Param<Tensor<1>>| values.val().reshape([1, channels, 1, 1]);
        centred / (variance + EPSILON).sqrt() * of_channels(&self.weight) + of_channels(&self.bias)
    }
}
