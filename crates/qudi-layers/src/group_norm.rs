//! Group normalisation and its activation.

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
    /// Creates a normalisation of `channels` channels, with weights of zero.
    pub fn zeros(channels: usize, device: &Device) -> Self {
        Self { weight: zeros([channels], device), bias: zeros([channels], device) }
    }

    /// Normalises `x`, `[images, channels, height, width]`.
    pub fn plain(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::None)
    }

    /// Normalises and applies SiLU.
    pub fn silu(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::Silu)
    }

    /// Normalises, applies `scale` and `shift` of each burst, `[bursts, channels]`, and applies SiLU.
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

/// Returns the number of groups: the largest divisor of the channels up to eight.
fn groups(channels: usize) -> usize {
    (1..=8).rev().find(|&groups| channels.is_multiple_of(groups)).unwrap_or(1)
}
