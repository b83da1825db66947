//! A step between fusion and U-Net: all that the U-Net goes on from, so that it can be computed part by part.

use super::features::Pyramid;
use crate::diffusion::precondition::Preconditioned;
use crate::diffusion::state::DiffusionState;
use burn::tensor::{Gradients, Tensor};
use qudi_layers::tensor::{gradient_of, product};

/// What the U-Net goes on from.
#[derive(Clone, Debug)]
pub struct Fused {
    /// Fused features on three levels.
    pub(super) pyramid: Pyramid,
    /// The pre-denoised frames, in image units: `[images, 1, height, width]`.
    pub(super) d: Tensor<4>,
    /// Sigma of their errors in [-1, 1].
    pub(super) sigma: Tensor<4>,
    /// Returns the state around these frames, where it is computed already.
    pub(super) noisy: Option<Preconditioned>,
    /// Linear estimate and counts in [-1, 1], `[images, 2, height, width]`.
    pub(super) measured: Tensor<4>,
    /// The encoded sensor, `[bursts, M]`.
    pub(super) sensor: Tensor<2>,
    pub(super) state: DiffusionState,
    /// Frames of a burst.
    pub(super) frames: usize,
}

/// Gradients for what the U-Net goes on from.
#[derive(Clone, Debug)]
pub struct FusedGradient {
    /// For the fused features.
    pub pyramid: Pyramid,
    /// For the pre-denoised frames.
    pub d: Tensor<4>,
    /// For the encoded sensor.
    pub sensor: Tensor<2>,
}

impl Fused {
    /// Returns the number of images.
    pub fn images(&self) -> usize {
        self.d.dims()[0]
    }

    /// Returns the pre-denoised frames, in image units: `[images, 1, height, width]`.
    pub fn d(&self) -> &Tensor<4> {
        &self.d
    }

    /// Returns the state around the pre-denoised frames.
    pub(super) fn noisy(&self) -> Preconditioned {
        let around =
            || Preconditioned::new(self.d.clone() * 2.0 - 1.0, self.sigma.clone(), &self.state);
        self.noisy.clone().unwrap_or_else(around)
    }

    /// Returns the same outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        self.map(&|x| x.inner(), self.sensor.clone().inner())
    }

    /// Returns image `number` alone, as a burst of one frame.
    #[must_use]
    pub fn image(&self, number: usize) -> Self {
        let burst = number / self.frames;
        let sensor = self.sensor.clone().narrow(0, burst, 1);
        let mut image = self.map(&|x| x.narrow(0, number, 1), sensor);
        image.state.has_previous = vec![self.state.has_previous[burst]];
        image.state.timesteps = vec![self.state.timesteps[burst]];
        image.frames = 1;
        image
    }

    /// Returns the same with gradients of its own, apart from what made it. It must be outside autodiff.
    #[must_use]
    pub fn into_leaf(self) -> Self {
        let sensor = Tensor::from_inner(self.sensor.clone()).require_grad();
        let leaf = self.map(&Tensor::from_inner, sensor);
        Self { pyramid: leaf.pyramid.map(Tensor::require_grad), d: leaf.d.require_grad(), ..leaf }
    }

    /// Returns the gradients of a [leaf](Self::into_leaf).
    pub fn gradient(&self, gradients: &Gradients) -> FusedGradient {
        FusedGradient {
            pyramid: self.pyramid.each_ref().map(|x| gradient_of(x, gradients)),
            d: gradient_of(&self.d, gradients),
            sensor: gradient_of(&self.sensor, gradients),
        }
    }

    /// Computes the sum of the features and the encoded sensors times these gradients: its gradient is what
    /// is left to do for them.
    pub fn product(&self, gradient: &FusedGradient) -> Tensor<1> {
        let features = self.pyramid.iter().zip(&gradient.pyramid);
        features
            .fold(product(self.sensor.clone(), gradient.sensor.clone()), |sum, (x, gradient)| {
                sum + product(x.clone(), gradient.clone())
            })
    }

    fn map(&self, f: &dyn Fn(Tensor<4>) -> Tensor<4>, sensor: Tensor<2>) -> Self {
        Self {
            pyramid: self.pyramid.clone().map(f),
            d: f(self.d.clone()),
            sigma: f(self.sigma.clone()),
            noisy: None,
            measured: f(self.measured.clone()),
            sensor,
            state: DiffusionState {
                x_t: f(self.state.x_t.clone()),
                x0_prev: f(self.state.x0_prev.clone()),
                ..self.state.clone()
            },
            frames: self.frames,
        }
    }
}

impl FusedGradient {
    /// Joins the gradients for all bursts of `frames` frames from the gradients of their parts, in their
    /// order.
    ///
    /// # Panics
    /// Without parts.
    #[must_use]
    pub fn joined(parts: Vec<Self>, frames: usize) -> Self {
        let joined =
            |of: &dyn Fn(&Self) -> Tensor<4>| Tensor::cat(parts.iter().map(of).collect(), 0);
        let sensors = Tensor::cat(parts.iter().map(|part| part.sensor.clone()).collect(), 0);
        let (pyramid, d) = (
            [0, 1, 2].map(|k| joined(&|part| part.pyramid[k].clone())),
            joined(&|part| part.d.clone()),
        );
        let [rows, size] = sensors.dims();
        let bursts = d.dims()[0] / frames;
        let sensor =
            sensors.reshape([bursts, rows / bursts, size]).sum_dim(1).reshape([bursts, size]);
        Self { pyramid, d, sensor }
    }
}
