//! Differences of blocks for block matching, without gradient.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::BlockBackend;

/// Radius of the means, in pixels.
const BLOCK_RADIUS: usize = 4;

/// Computes the mean squared difference between the block of 9 x 9 pixels around every pixel of `reference`
/// and the blocks of `neighbour` displaced by up to `radius` pixels, with repeated edges. None where it is
/// composed of Burn's operations.
///
/// # Shapes
/// - reference, neighbour: `[pairs, 1, height, width]`, outside autodiff
/// - output: `[pairs, side * side, height, width]` with `side = 2 * radius + 1`; displacements by rows
pub fn block_differences(
    reference: &Tensor<4>,
    neighbour: &Tensor<4>,
    radius: usize,
) -> Option<Tensor<4>> {
    let is_one_operation =
        is_native(reference) && !reference.is_autodiff() && reference.shape().num_elements() > 0;
    is_one_operation.then(|| {
        let [reference, neighbour] = [reference, neighbour].map(|x| x.clone().into_dispatch());
        Tensor::from_dispatch(Dispatch::block_differences(reference, neighbour, radius))
    })
}
