//! A stack of residual blocks by LibTorch's convolutions.

use super::Stack;
use crate::libtorch::channels_last;
use tch::{Kind, Tensor};

/// Applies the stack to its inputs, `[images, channels, height, width]` each, and its parameters, which come
/// last. With 16 bits all activations have them, as on the matrix units of processors.
pub(super) fn forward(values: &[Tensor], stack: &Stack) -> Tensor {
    let (parameters, inputs) = values.split_last().expect("parameters come last");
    let kind = if stack.bf16 { Kind::BFloat16 } else { Kind::Float };
    let inputs: Vec<Tensor> = inputs.iter().map(|input| input.to_kind(kind)).collect();
    let parameters = parameters.to_kind(kind);
    let mut first = 0;
    let mut take = |count: usize| {
        first += count as i64;
        parameters.narrow(0, first - count as i64, count as i64)
    };
    let layers: Vec<(Tensor, Tensor)> = stack
        .convolutions()
        .map(|[inputs, outputs]| {
            let weight = take(9 * inputs * outputs).view([outputs as i64, inputs as i64, 3, 3]);
            (weight, take(outputs))
        })
        .collect();
    let conv = |x: &Tensor, number: usize| {
        let (weight, bias) = &layers[number];
        x.conv2d(weight, Some(bias), [1, 1], [1, 1], [1, 1], 1)
    };
    let mut x = conv(&channels_last(&Tensor::cat(&inputs, 1)), 0);
    if stack.rectifies() {
        x = x.relu();
    }
    for block in 0..stack.blocks {
        let hidden = conv(&x, 1 + 2 * block).relu();
        x = &x + conv(&hidden, 2 + 2 * block);
    }
    x.to_kind(Kind::Float)
}
