//! Pieces that several networks are made of.

mod activation;
mod conv_transpose;
mod deformable;
mod depthwise;
mod layer_norm;
mod losses;
mod names;
mod residual;
mod resize;
mod spynet;
mod warping;

pub use activation::{leaky, leaky_layers};
pub use conv_transpose::ConvTranspose;
pub use deformable::{deform_conv, deform_samples};
pub use depthwise::Depthwise;
pub use layer_norm::LayerNorm;
pub use losses::{charbonnier, gradient_loss};
pub use names::{dense_blocks_renamed, every_second, renamed};
pub use residual::Residual;
pub use resize::{Corners, quarter, resize};
pub use spynet::SpyNet;
pub use warping::{masked_warp, same_flow, warp_zeros};

use burn::tensor::Tensor;
use qudi_layers::resample::by_burst;

/// Returns frame `number` of every burst.
///
/// # Shapes
/// - x: `[bursts * frames, channels, height, width]`
/// - result: `[bursts, channels, height, width]`
pub fn frame(x: &Tensor<4>, frames: usize, number: usize) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let one = by_burst(x.clone(), frames).narrow(1, number, 1);
    one.reshape([images / frames, channels, height, width])
}

/// Returns consecutive frames of every burst.
///
/// # Shapes
/// - x: `[bursts * frames, channels, height, width]`
/// - result: `[bursts * count, channels, height, width]`
pub fn frames_from(x: &Tensor<4>, frames: usize, first: usize, count: usize) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let some = by_burst(x.clone(), frames).narrow(1, first, count);
    some.reshape([images / frames * count, channels, height, width])
}

/// Applies `f` to every image by itself: all at once would take more memory.
///
/// # Shapes
/// - x: `[images, channels, height, width]`
pub fn one_by_one(x: &Tensor<4>, f: impl Fn(Tensor<4>) -> Tensor<4>) -> Tensor<4> {
    let images = x.dims()[0];
    Tensor::cat((0..images).map(|number| f(x.clone().narrow(0, number, 1))).collect(), 0)
}

/// Joins frames to bursts: the inverse of [`frame`].
///
/// # Shapes
/// - frames: `[bursts, channels, height, width]` each
/// - result: `[bursts * frames, channels, height, width]`
pub fn bursts_of(frames: Vec<Tensor<4>>) -> Tensor<4> {
    let count = frames.len();
    let [bursts, channels, height, width] = frames[0].dims();
    Tensor::stack::<5>(frames, 1).reshape([bursts * count, channels, height, width])
}
