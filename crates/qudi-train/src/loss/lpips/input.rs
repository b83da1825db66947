//! Images for networks of coloured ones, gray ones among them.
//!
//! LPIPS maps an image `p` in [0, 1] to `x = 2 p - 1`, and channel `c` to `(x - shift_c) / scale_c`; the
//! first layer then sums over three channels with weights `w_c`, beyond the borders of which there are zeros.
//! That is the sum of the planes of `p` times `2 w_c / scale_c` and of a plane of ones times `-sum_c w_c (1 +
//! shift_c) / scale_c`, beyond the borders of which there are zeros, too. The three planes of gray images are
//! the same, so that one does with the sum of their weights: two planes for three, exactly, and nothing is
//! computed on the image itself.

use burn::tensor::{Tensor, s};

/// The number of channels of the original.
const CHANNELS: usize = 3;

/// LPIPS's ScalingLayer: means of red, green and blue on [-1, 1].
const SHIFT: [f64; CHANNELS] = [-0.030, -0.088, -0.188];

/// LPIPS's ScalingLayer: standard deviations.
const SCALE: [f64; CHANNELS] = [0.458, 0.448, 0.450];

/// Images that are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Images {
    /// One plane of gray.
    Gray,
    /// Red, green and blue.
    Colour,
}

impl Images {
    /// Returns the number of planes of the first layer: the images' own, and ones.
    pub(super) fn planes(self) -> usize {
        match self {
            Self::Gray => 2,
            Self::Colour => CHANNELS + 1,
        }
    }

    /// Turns first-layer weights `[outputs, 3, taps]` into weights for [`with_ones`], `[outputs, planes,
    /// taps]`.
    pub(super) fn fold(self, weight: &[f32], taps: usize) -> Vec<f32> {
        let outputs = weight.chunks_exact(CHANNELS * taps);
        let mut folded = Vec::with_capacity(outputs.len() * self.planes() * taps);
        for output in outputs {
            let value = |c: usize, tap: usize| f64::from(output[c * taps + tap]);
            let sum = |factor: fn(usize) -> f64, tap: usize| {
                (0..CHANNELS).map(|c| value(c, tap) * factor(c)).sum::<f64>() as f32
            };
            let factor = |c: usize| 2.0 / SCALE[c];
            match self {
                Self::Gray => folded.extend((0..taps).map(|tap| sum(factor, tap))),
                Self::Colour => {
                    for c in 0..CHANNELS {
                        folded.extend((0..taps).map(|tap| (value(c, tap) * factor(c)) as f32));
                    }
                }
            }
            folded.extend((0..taps).map(|tap| sum(|c| -(1.0 + SHIFT[c]) / SCALE[c], tap)));
        }
        folded
    }
}

/// Adds a plane of ones to images.
///
/// # Shapes
/// - images: `[images, planes, height, width]` in [0, 1]
/// - output: `[images, planes + 1, height, width]`
pub(super) fn with_ones(images: Tensor<4>) -> Tensor<4> {
    let ones = images.clone().detach().slice(s![.., 0..1, .., ..]).ones_like();
    Tensor::cat(vec![images, ones], 1)
}
