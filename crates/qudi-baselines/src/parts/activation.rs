//! The activation that most of these networks have, and layers with it.

use burn::tensor::Tensor;
use burn::tensor::activation::leaky_relu;
use qudi_layers::Conv2d;

/// Applies a ReLU with slope 0.1 for negative values.
pub fn leaky(x: Tensor<4>) -> Tensor<4> {
    leaky_relu(x, 0.1)
}

/// Applies layers one after the other, each but the last followed by [`leaky`].
///
/// # Panics
/// Without layers.
pub fn leaky_layers(layers: &[Conv2d], inputs: Vec<Tensor<4>>) -> Tensor<4> {
    let (last, first) = layers.split_last().expect("a layer");
    let inputs = first.iter().fold(inputs, |x, layer| vec![leaky(layer.linear(&x))]);
    last.linear(&inputs)
}
