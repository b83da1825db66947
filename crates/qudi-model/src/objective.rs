//! What training minimises (DESIGN 4.8): squared error and differences of gradients, of the prediction and of
//! the pre-denoised frames.

use burn::tensor::Tensor;

/// Weight of the total variation of the error.
const VARIATION: f32 = 0.01;

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of the prediction.
    pub prediction: f32,
    /// Of the pre-denoised frames.
    pub pre: f32,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self { prediction: 1.0, pre: 0.2 }
    }
}

/// `mean (p - q)^2 + 0.01 (mean |across| + mean |down|)`, where across and down are differences of neighbours of
/// `p - q` along rows and columns. `p`, `q`: `[images, 1, height, width]` in [0, 1]; result `[1]`.
pub fn reconstruction(p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
    let error = p - q;
    let [_, _, height, width] = error.dims();
    let difference = |axis: usize, size: usize| {
        let part = |first| error.clone().narrow(axis, first, size - 1);
        (part(1) - part(0)).abs().mean()
    };
    let variation = difference(3, width) + difference(2, height);
    error.powi_scalar(2).mean() + variation * VARIATION
}
