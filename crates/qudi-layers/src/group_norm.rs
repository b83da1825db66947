//! Group normalisation with what comes after it.

use super::parameters::zeros;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use qudi_kernels::group_norm::{self, Norm, group_norm};

/// Group normalisation.
#[derive(Module, Debug)]
pub struct GroupNorm {
    /// `[channels]`
    weight: Param<Tensor<1>>,
    /// `[channels]`
    bias: Param<Tensor<1>>,
}

impl GroupNorm {
    /// The norm of so many channels, weights zero.
    pub fn zeros(channels: usize, device: &Device) -> Self {
        Self { weight: zeros([channels], device), bias: zeros([channels], device) }
    }

    /// The norm alone. `x`: `[images, channels, height, width]`.
    pub fn plain(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::None)
    }

    /// The norm and SiLU.
    pub fn silu(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::Silu)
    }

    /// The norm, `scale` and `shift` of every burst, and SiLU. `scale`, `shift`: `[bursts, channels]`.
    pub fn film_silu(&self, x: Tensor<4>, scale: Tensor<2>, shift: Tensor<2>) -> Tensor<4> {
        let slope = scale + 1.0;
        let weight = slope.clone() * self.weight.val().unsqueeze();
        let bias = slope * self.bias.val().unsqueeze() + shift;
        let norm = Norm { groups: groups(x.dims()[1]), activation: group_norm::Activation::Silu };
        group_norm(x, weight, bias, norm)
    }

    fn call(&self, x: Tensor<4>, activation: group_norm::Activation) -> Tensor<4> {
        let norm = Norm { groups: groups(x.dims()[1]), activation };
        group_norm(x, self.weight.val().unsqueeze(), self.bias.val().unsqueeze(), norm)
    }
}

/// The largest divisor of the channels that is at most eight.
fn groups(channels: usize) -> usize {
    (1..=8).rev().find(|&groups| channels.is_multiple_of(groups)).unwrap_or(1)
}
