//! Merging of the frames of bursts along their motion, without gradient.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::MergeBackend;

/// How much a neighbour counts, where the frame itself counts 1: `1 / (1 + (square / tolerance)^power)`. Its
/// `square` is the mean squared difference over 10 x 10 pixels in units of the usual squared error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MergeRule {
    /// Mean square at which a neighbour counts half.
    pub tolerance: f32,
    /// Exponent.
    pub power: i32,
}

/// Merges every frame of a burst with its neighbours, sampled along the flow by
/// [`warp_cubic`](crate::warp_cubic). `None` where it has to be composed of other operations.
///
/// # Shapes
/// - images: `[bursts * frames, c, height, width]`; differences of the first channel decide on the weights,
///   the last one is merged
/// - sigma: usual errors of the first channel, `[bursts * frames, 1, 1, 1]`
/// - flows: by distance, to later frames first, in cells of 2 x 2 pixels:
///   `[bursts * (frames - distance), 2, height / 2, width / 2]` each
/// - result: the mean, and the number of frames without weights whose mean would have as little noise,
///   `[bursts * frames, 2, height, width]`
pub fn merged_frames(
    images: &Tensor<4>,
    sigma: &Tensor<4>,
    flows: &[[Tensor<4>; 2]],
    frames: usize,
    rule: MergeRule,
) -> Option<Tensor<4>> {
    if images.is_autodiff() || !is_native(images) || images.shape().num_elements() == 0 {
        return None;
    }
    let [_, _, height, width] = images.dims();
    let none = Tensor::zeros([0, 2, height / 2, width / 2], &images.device());
    let flows: Vec<Tensor<4>> =
        std::iter::once(&none).chain(flows.iter().flatten()).cloned().collect();
    let flows = Tensor::cat(flows, 0);
    let [images, sigma, flows] = [images.clone(), sigma.clone(), flows].map(Tensor::into_dispatch);
    Some(Tensor::from_dispatch(Dispatch::merged_frames(images, sigma, flows, frames, rule)))
}
