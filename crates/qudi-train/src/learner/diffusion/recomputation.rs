//! Gradient checkpointing (Chen et al. 2016) of pre-denoiser and U-Net, whose activations take most of the
//! memory: the forward pass keeps their results alone, and the backward pass computes them again, image by
//! image.

use crate::parameters::gradients;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_layers::tensor::{gradient_of, product};
use qudi_model::diffusion::{
    Conditioning, Diffusion, Fused, FusedGradient, Predenoised, Simulated,
};

/// Pre-denoised frames that a loss was computed from, without what made them.
#[derive(Clone, Debug)]
pub(super) struct KeptFrames {
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
    pub(super) predenoised: KeptFrames,
    pub(super) predicted: Predicted,
    /// The part of the loss that is made of clean images and pre-denoised frames.
    pub(super) of_images: Tensor<1>,
    /// The part that is made of flows.
    pub(super) of_flows: Option<Tensor<1>>,
}

/// Joins the parts of a result of the forward pass into a leaf that gets a gradient.
fn leaf(parts: Vec<Tensor<4>>) -> Tensor<4> {
    Tensor::from_inner(Tensor::cat(parts, 0)).require_grad()
}

fn add(sum: Vec<Tensor<1>>, more: Vec<Tensor<1>>) -> Vec<Tensor<1>> {
    sum.into_iter().zip(more).map(|(a, b)| a + b).collect()
}

impl KeptFrames {
    /// Pre-denoises all images, one after the other, without gradient.
    pub(super) fn new(
        network: &Diffusion,
        conditioning: &Conditioning,
        simulated: Option<&Simulated>,
    ) -> Self {
        let (valid, conditioning) = (network.valid(), conditioning.inner());
        let simulated = simulated.map(Simulated::inner);
        let images = conditioning.counts.dims()[0];
        let one = |number: usize| {
            let simulated = simulated.as_ref().map(|s| s.image(number, conditioning.frames));
            let image = conditioning.image(number);
            let Predenoised { d, features } = valid.predenoise(&image, simulated.as_ref());
            (d, features)
        };
        let (d, features): (Vec<_>, Vec<_>) = (0..images).map(one).unzip();
        Self { d: leaf(d), features: leaf(features), simulated }
    }

    /// Returns the pre-denoised frames and their features.
    pub(super) fn frames(&self) -> Predenoised {
        Predenoised { d: self.d.clone(), features: self.features.clone() }
    }

    /// Adds the gradients through the pre-denoiser from those for its results.
    fn add_gradients(
        &self,
        network: &Diffusion,
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
            let Predenoised { d, features } = network.predenoise(&image, simulated.as_ref());
            let total = product(d, to_d.clone().narrow(0, number, 1))
                + product(features, to_features.clone().narrow(0, number, 1));
            add(sum, gradients(network, &total.backward()))
        })
    }
}

impl Predicted {
    /// Predicts all images, one after the other, without gradient.
    pub(super) fn new(network: &Diffusion, fused: Fused) -> Self {
        let (valid, inner) = (network.valid(), fused.inner());
        let one = |number| valid.predict(&inner.image(number));
        let (x0, unit): (Vec<_>, Vec<_>) = (0..fused.images()).map(one).unzip();
        Self { x0: leaf(x0), unit: Tensor::from_inner(Tensor::cat(unit, 0)), fused }
    }

    /// Returns the clean images and the scales of their corrections.
    pub(super) fn results(&self) -> (Tensor<4>, Tensor<4>) {
        (self.x0.clone(), self.unit.clone())
    }

    /// Adds the gradients of the U-Net's parameters, and gives those for what it goes on from.
    fn add_gradients(
        &self,
        network: &Diffusion,
        frames: usize,
        to_x0: &Tensor<4>,
        mut sum: Vec<Tensor<1>>,
    ) -> (Vec<Tensor<1>>, FusedGradient) {
        let inner = self.fused.inner();
        let mut before = Vec::new();
        for number in 0..self.fused.images() {
            let part = inner.image(number).into_leaf();
            let (x0, _) = network.predict(&part);
            let after = product(x0, to_x0.clone().narrow(0, number, 1)).backward();
            sum = add(sum, gradients(network, &after));
            before.push(part.gradient(&after));
        }
        (sum, FusedGradient::joined(before, frames))
    }
}

impl Recomputation {
    /// Computes the gradients of all parameters.
    pub(super) fn gradients(
        &self,
        network: &Diffusion,
        conditioning: &Conditioning,
    ) -> Vec<Tensor<1>> {
        let Self { predenoised, predicted, of_images, of_flows } = self;
        let KeptFrames { d, features, .. } = predenoised;
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
