//! Where the reverse process stands.

use burn::tensor::{Device, Tensor};

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

impl DiffusionState {
    /// Returns the previous estimate, zero where there is none.
    pub(crate) fn previous(&self) -> Tensor<4> {
        self.x0_prev.clone() * self.has_previous_flag()
    }

    /// One where a burst has a previous estimate, else zero: `[bursts * frames, 1, 1, 1]`.
    pub(crate) fn has_previous_flag(&self) -> Tensor<4> {
        let flags = self.has_previous.iter().map(|&has| f32::from(u8::from(has)));
        per_image(flags.collect(), self.x_t.dims()[0], &self.x_t.device())
    }
}

/// One value for every image of a burst: `[images, 1, 1, 1]` from one value for every burst.
pub fn per_image(values: Vec<f32>, images: usize, device: &Device) -> Tensor<4> {
    let bursts = values.len();
    let values = Tensor::<1>::from_floats(values.as_slice(), device);
    values.reshape([bursts, 1]).repeat_dim(1, images / bursts).reshape([images, 1, 1, 1])
}
