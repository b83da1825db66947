//! Gradient checkpointing (Chen et al. 2016) of the pre-denoiser, whose activations take most of the memory of deep
//! ones: the forward pass keeps its results alone, and the backward pass computes it again, image by image.

use crate::parameters::gradients;
use burn::module::Module;
use burn::tensor::{Gradients, Tensor};
use qudi_model::conditioning::Conditioning;
use qudi_model::network::{Qudi, Simulated};

/// Pre-denoised frames that a loss was computed from, without what made them.
#[derive(Clone, Debug)]
pub struct Recomputation {
    d: Tensor<4>,
    features: Tensor<4>,
    simulated: Option<Simulated>,
}

impl Recomputation {
    /// Pre-denoises all images, one after the other, without gradient.
    pub(super) fn new(
        network: &Qudi,
        conditioning: &Conditioning,
        simulated: Option<&Simulated>,
    ) -> Self {
        let (valid, conditioning) = (network.valid(), conditioning.inner());
        let simulated = simulated.map(Simulated::inner);
        let images = conditioning.counts.dims()[0];
        let one = |number: usize| {
            let simulated = simulated.as_ref().map(|s| s.image(number, conditioning.frames));
            valid.predenoise_simulated(&conditioning.image(number), simulated.as_ref())
        };
        let (d, features): (Vec<_>, Vec<_>) = (0..images).map(one).unzip();
        let leaf = |parts: Vec<Tensor<4>>| Tensor::from_inner(Tensor::cat(parts, 0)).require_grad();
        Self { d: leaf(d), features: leaf(features), simulated }
    }

    /// The pre-denoised frames and their features.
    pub(super) fn results(&self) -> (Tensor<4>, Tensor<4>) {
        (self.d.clone(), self.features.clone())
    }

    /// The gradients of all parameters through the pre-denoiser, from those of what follows it.
    pub fn gradients(
        &self,
        network: &Qudi,
        conditioning: &Conditioning,
        after: &Gradients,
    ) -> Vec<Tensor<1>> {
        let of = |x: &Tensor<4>| x.grad(after).unwrap_or_else(|| x.clone().inner().zeros_like());
        let (to_d, to_features) = (of(&self.d), of(&self.features));
        let mut sum: Option<Vec<Tensor<1>>> = None;
        for number in 0..self.d.dims()[0] {
            let simulated = self.simulated.as_ref().map(|simulated| {
                let Simulated { y, u, exists } = simulated.image(number, conditioning.frames);
                Simulated { y: Tensor::from_inner(y), u: Tensor::from_inner(u), exists }
            });
            let image = conditioning.image(number);
            let (d, features) = network.predenoise_simulated(&image, simulated.as_ref());
            let product = |x: Tensor<4>, gradient: &Tensor<4>| {
                (x * Tensor::from_inner(gradient.clone().narrow(0, number, 1))).sum()
            };
            let total = product(d, &to_d) + product(features, &to_features);
            let list = gradients(network, &total.backward());
            sum = Some(match sum {
                None => list,
                Some(sum) => sum.into_iter().zip(list).map(|(a, b)| a + b).collect(),
            });
        }
        sum.unwrap_or_default()
    }
}
