//! Gradient checkpointing (Chen et al. 2016) of pre-denoiser and U-Net, whose activations take most of the memory:
//! the forward pass keeps their results alone, and the backward pass computes them again, image by image.

use crate::parameters::gradients;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_layers::tensor::{gradient_of, product};
use qudi_model::conditioning::Conditioning;
use qudi_model::network::{Fused, FusedGradient, Qudi, Simulated};

/// Pre-denoised frames that a loss was computed from, without what made them.
#[derive(Clone, Debug)]
pub(super) struct PreDenoised {
    d: Tensor<4>,
    features: Tensor<4>,
    simulated: Option<Simulated>,
}

/// Clean images that a loss was computed from, without what made them of fused features.
#[derive(Clone, Debug)]
pub(super) struct Predicted {
    x0: Tensor<4>,
    unit: Tensor<4>,
    fused: Fused,
}

/// What is left to do for the gradients of a loss.
#[derive(Clone, Debug)]
pub(super) struct Recomputation {
    pub(super) predenoised: PreDenoised,
    pub(super) predicted: Predicted,
    /// The part of the loss that is made of clean images and pre-denoised frames.
    pub(super) of_images: Tensor<1>,
    /// The part that is made of flows.
    pub(super) of_flows: Option<Tensor<1>>,
}

/// A result of the forward pass that a gradient is wanted for.
fn leaf(parts: Vec<Tensor<4>>) -> Tensor<4> {
    Tensor::from_inner(Tensor::cat(parts, 0)).require_grad()
}

fn add(sum: Vec<Tensor<1>>, more: Vec<Tensor<1>>) -> Vec<Tensor<1>> {
    sum.into_iter().zip(more).map(|(a, b)| a + b).collect()
}

impl PreDenoised {
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
        Self { d: leaf(d), features: leaf(features), simulated }
    }

    /// The pre-denoised frames and their features.
    pub(super) fn results(&self) -> (Tensor<4>, Tensor<4>) {
        (self.d.clone(), self.features.clone())
    }

    /// Adds the gradients through the pre-denoiser from those for its results.
    fn add_gradients(
        &self,
        network: &Qudi,
        conditioning: &Conditioning,
        [to_d, to_features]: [Tensor<4>; 2],
        sum: Vec<Tensor<1>>,
    ) -> Vec<Tensor<1>> {
        (0..to_d.dims()[0]).fold(sum, |sum, number| {
            let simulated = self.simulated.as_ref().map(|simulated| {
                let Simulated { y, u, exists } = simulated.image(number, conditioning.frames);
                Simulated { y: Tensor::from_inner(y), u: Tensor::from_inner(u), exists }
            });
            let image = conditioning.image(number);
            let (d, features) = network.predenoise_simulated(&image, simulated.as_ref());
            let total = product(d, to_d.clone().narrow(0, number, 1))
                + product(features, to_features.clone().narrow(0, number, 1));
            add(sum, gradients(network, &total.backward()))
        })
    }
}

impl Predicted {
    /// Predicts all images, one after the other, without gradient; bursts where the U-Net sees all their frames
    /// together.
    pub(super) fn new(network: &Qudi, fused: Fused, frames: usize) -> Self {
        let (valid, inner) = (network.valid(), fused.inner());
        let parts = parts(network, &fused, frames);
        let parts = parts.map(|(first, count)| valid.predict(&inner.part(first, count)));
        let (x0, unit): (Vec<_>, Vec<_>) = parts.unzip();
        Self { x0: leaf(x0), unit: Tensor::from_inner(Tensor::cat(unit, 0)), fused }
    }

    /// The clean images and the units of their corrections.
    pub(super) fn results(&self) -> (Tensor<4>, Tensor<4>) {
        (self.x0.clone(), self.unit.clone())
    }

    /// Adds the gradients of the U-Net's parameters, and gives those for what it goes on from.
    fn add_gradients(
        &self,
        network: &Qudi,
        frames: usize,
        to_x0: &Tensor<4>,
        mut sum: Vec<Tensor<1>>,
    ) -> (Vec<Tensor<1>>, FusedGradient) {
        let inner = self.fused.inner();
        let mut before = Vec::new();
        for (first, count) in parts(network, &self.fused, frames) {
            let part = inner.part(first, count).into_leaf();
            let (x0, _) = network.predict(&part);
            let after = product(x0, to_x0.clone().narrow(0, first, count)).backward();
            sum = add(sum, gradients(network, &after));
            before.push(part.gradient(&after));
        }
        (sum, FusedGradient::joined(before, frames))
    }
}

/// First image and number of images of the parts that the U-Net can compute one by one.
fn parts(network: &Qudi, fused: &Fused, frames: usize) -> impl Iterator<Item = (usize, usize)> {
    let count = if network.attends_over_time() { frames } else { 1 };
    (0..fused.images()).step_by(count).map(move |first| (first, count))
}

impl Recomputation {
    /// The gradients of all parameters.
    pub(super) fn gradients(&self, network: &Qudi, conditioning: &Conditioning) -> Vec<Tensor<1>> {
        let Self { predenoised, predicted, of_images, of_flows } = self;
        let PreDenoised { d, features, .. } = predenoised;
        let last = of_images.backward();
        let to_x0 = gradient_of(&predicted.x0, &last);
        let sum = gradients(network, &last);
        let (sum, before) = predicted.add_gradients(network, conditioning.frames, &to_x0, sum);
        let mut middle = predicted.fused.product(&before);
        if let Some(flows) = of_flows {
            middle = middle + flows.clone();
        }
        let middle = middle.backward();
        let sum = add(sum, gradients(network, &middle));
        let to_d = gradient_of(d, &last) + before.d + gradient_of(d, &middle);
        let to_features = gradient_of(features, &last) + gradient_of(features, &middle);
        predenoised.add_gradients(network, conditioning, [to_d, to_features], sum)
    }
}
