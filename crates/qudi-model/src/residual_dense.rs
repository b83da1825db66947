//! The trunk of both pre-denoisers: a residual dense network (Zhang et al. 2018).

use burn::tensor::Tensor;
use qudi_layers::{Conv2d, DenseBlock};

/// Computes the features of `shallow` ones: dense blocks one after the other, all their outputs gathered.
///
/// # Shapes
/// - shallow, result: `[images, width, h, w]`
pub(crate) fn features(
    shallow: Tensor<4>,
    blocks: &[DenseBlock],
    gather: &Conv2d,
    spread: &Conv2d,
) -> Tensor<4> {
    let mut x = shallow.clone();
    let mut outputs = Vec::with_capacity(blocks.len());
    for block in blocks {
        x = block.forward(x);
        outputs.push(x.clone());
    }
    spread.add(&[gather.linear(&outputs)], shallow)
}
