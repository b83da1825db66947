//! Where the reverse process stands.

use burn::tensor::Tensor;

/// The noisy image at a timestep, and the estimate of the step before.
///
/// # Shapes
/// - x_t, x0_prev: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct DiffusionState {
    /// The noisy image.
    pub x_t: Tensor<4>,
    /// The previous estimate of the clean image, in [-1, 1].
    pub x0_prev: Tensor<4>,
    /// Whether each burst has a previous estimate.
    pub has_previous: Vec<bool>,
    /// The timestep of every burst.
    pub timesteps: Vec<usize>,
}
