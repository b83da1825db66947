//! Images for networks of normalized coloured ones.
//!
//! LPIPS maps an image `p` in [0, 1] to `x = 2 p - 1`, and channel `c` to `(x - shift_c) / scale_c`; the
//! first layer then sums over three channels with weights `w_c`, beyond the borders of which there are zeros.
//! For gray images that is the sum of `p` times `sum_c 2 w_c / scale_c` and of a plane of ones times `-sum_c
//! w_c (1 + shift_c) / scale_c`, beyond the borders of which there are zeros, too. So two planes do for
//! three, exactly, and nothing is computed on the image itself. Of coloured images, which are given as `x`,
//! it is the sum of `x_c` times `w_c / scale_c` and of ones times `-sum_c w_c shift_c / scale_c`.

use burn::tensor::Tensor;

/// The number of channels of the original.
const CHANNELS: usize = 3;

/// LPIPS's ScalingLayer: means of red, green and blue on [-1, 1].
const SHIFT: [f64; CHANNELS] = [-0.030, -0.088, -0.188];

/// LPIPS's ScalingLayer: standard deviations.
const SCALE: [f64; CHANNELS] = [0.458, 0.448, 0.450];

/// The images that are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Input {
    /// One plane in [0, 1], which stands for three.
    Gray,
    /// Red, green and blue as the network takes them, usually in [-1, 1].
    Colour,
}

impl Input {
    /// Returns the number of planes of an image.
    pub(super) fn images(self) -> usize {
        match self {
            Self::Gray => 1,
            Self::Colour => CHANNELS,
        }
    }

    /// Returns the number of planes with the plane of ones.
    pub(super) fn planes(self) -> usize {
        self.images() + 1
    }

    /// Turns first-layer weights `[outputs, 3, taps]` into `[outputs, planes, taps]` for [`with_ones`].
    pub(super) fn fold(self, weight: &[f32], taps: usize) -> Vec<f32> {
        let outputs = weight.chunks_exact(CHANNELS * taps);
        let mut folded = Vec::with_capacity(outputs.len() * self.planes() * taps);
        for output in outputs {
            let value = |c: usize, tap: usize| f64::from(output[c * taps + tap]);
            let sum = |factor: fn(usize) -> f64, tap: usize| {
                (0..CHANNELS).map(|c| value(c, tap) * factor(c)).sum::<f64>() as f32
            };
            match self {
                Self::Gray => {
                    folded.extend((0..taps).map(|tap| sum(|c| 2.0 / SCALE[c], tap)));
                    folded.extend((0..taps).map(|tap| sum(|c| -(1.0 + SHIFT[c]) / SCALE[c], tap)));
                }
                Self::Colour => {
                    for (c, scale) in SCALE.into_iter().enumerate() {
                        folded.extend((0..taps).map(|tap| (value(c, tap) / scale) as f32));
                    }
                    folded.extend((0..taps).map(|tap| sum(|c| -SHIFT[c] / SCALE[c], tap)));
                }
            }
        }
        folded
    }
}

/// Adds a plane of ones to images.
///
/// # Shapes
/// - images: `[images, planes, height, width]`
/// - output: `[images, planes + 1, height, width]`
pub(super) fn with_ones(images: Tensor<4>) -> Tensor<4> {
    let ones = images.clone().detach().narrow(1, 0, 1).ones_like();
    Tensor::cat(vec![images, ones], 1)
}
