//! Single-head self-attention over the cells of a frame.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use burn::tensor::activation::softmax;
use extension::AttentionBackend;

/// Computes `softmax(q k^T / sqrt(C)) v` over the cells of each image.
///
/// # Shapes
/// `qkv`: `[images, 3 C, height, width]`, queries, keys and values joined by channel; result `[images, C,
/// height, width]`.
pub fn attention(qkv: Tensor<4>) -> Tensor<4> {
    let [images, channels, height, width] = qkv.dims();
    assert_eq!(channels % 3, 0, "queries, keys and values of the same size");
    if is_native(&qkv) {
        return Tensor::from_dispatch(Dispatch::cell_attention(qkv.into_dispatch()));
    }
    let channels = channels / 3;
    let qkv = qkv.reshape([images, 3 * channels, height * width]);
    let part = |n: usize| qkv.clone().narrow(1, n * channels, channels);
    let scale = (channels as f32).sqrt().recip();
    let scores = (part(0) * scale).swap_dims(1, 2).matmul(part(1)); // [images, queries, keys]
    let mixed = softmax(scores, 2).matmul(part(2).swap_dims(1, 2)); // [images, queries, C]
    mixed.swap_dims(1, 2).reshape([images, channels, height, width])
}
