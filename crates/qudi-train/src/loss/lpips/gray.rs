//! Gray images for networks of coloured ones.
//!
//! LPIPS maps an image `p` in [0, 1] to `x = 2 p - 1`, and channel `c` to `(x - shift_c) / scale_c`; the
//! first layer then sums over three channels with weights `w_c`, beyond the borders of which there are zeros.
//! For gray images that is the sum of `p` times `sum_c 2 w_c / scale_c` and of a plane of ones times `-sum_c
//! w_c (1 + shift_c) / scale_c`, beyond the borders of which there are zeros, too. So two planes do for
//! three, exactly, and nothing is computed on the image itself.

use burn::tensor::Tensor;

/// The number of planes: the image and ones.
pub(super) const PLANES: usize = 2;

/// The number of channels of the original.
const CHANNELS: usize = 3;

/// LPIPS's ScalingLayer: means of red, green and blue on [-1, 1].
const SHIFT: [f64; CHANNELS] = [-0.030, -0.088, -0.188];

/// LPIPS's ScalingLayer: standard deviations.
const SCALE: [f64; CHANNELS] = [0.458, 0.448, 0.450];

/// Turns first-layer weights `[outputs, 3, taps]` into those for [`planes`], `[outputs, 2, taps]`.
pub(super) fn fold(weight: &[f32], taps: usize) -> Vec<f32> {
    let outputs = weight.chunks_exact(CHANNELS * taps);
    let mut folded = Vec::with_capacity(outputs.len() * PLANES * taps);
    for output in outputs {
        let sum = |factor: fn(usize) -> f64, tap: usize| {
            (0..CHANNELS).map(|c| f64::from(output[c * taps + tap]) * factor(c)).sum::<f64>() as f32
        };
        folded.extend((0..taps).map(|tap| sum(|c| 2.0 / SCALE[c], tap)));
        folded.extend((0..taps).map(|tap| sum(|c| -(1.0 + SHIFT[c]) / SCALE[c], tap)));
    }
    folded
}

/// Adds a plane of ones to images.
///
/// # Shapes
/// - images: `[images, 1, height, width]` in [0, 1]
/// - output: `[images, 2, height, width]`
pub(super) fn planes(images: Tensor<4>) -> Tensor<4> {
    let ones = images.clone().detach().ones_like();
    Tensor::cat(vec![images, ones], 1)
}
