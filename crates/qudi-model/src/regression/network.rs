//! The weights of the regression: two pre-denoisers and the uncertainty head.

use super::config::{FirstFrames, RegressionConfig};
use super::input::NormalizedInput;
use super::predenoiser::PreDenoiser;
use super::uncertainty::UncertaintyHead;
use crate::aligned::Aligned;
use crate::initial::initial_values;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::init_parameters;

/// The network of the regression.
#[derive(Module, Debug)]
pub struct Regression {
    /// First pre-denoiser: the window is aligned again on what it restores. None where the frames of another
    /// network take its place.
    refinement: Option<PreDenoiser>,
    /// Second pre-denoiser.
    pre: PreDenoiser,
    uncertainty: UncertaintyHead,
}

impl RegressionConfig {
    /// Creates the network with initial weights of `seed`, the same on every device. The sizes must be
    /// [checked](Self::checked).
    pub fn init(&self, seed: u64, device: &Device) -> Regression {
        let initial = |name: &str, shape: &[usize]| initial_values(seed, name, shape);
        init_parameters(self.uninitialized(device), initial)
    }

    /// Creates the network without weights: it takes no memory yet.
    pub fn uninitialized(&self, device: &Device) -> Regression {
        let refinement = (self.first == FirstFrames::Refinement)
            .then(|| self.init_predenoiser(self.first_neighbours(), device));
        Regression {
            refinement,
            pre: self.init_predenoiser(self.second_neighbours(), device),
            uncertainty: self.init_uncertainty(device),
        }
    }
}

impl Regression {
    /// Returns the first pre-denoiser, if the network has one.
    pub fn refinement(&self) -> Option<&PreDenoiser> {
        self.refinement.as_ref()
    }

    /// Returns the network without its first pre-denoiser, to correct frames of another network.
    #[must_use]
    pub fn without_refinement(self) -> Self {
        Self { refinement: None, ..self }
    }

    /// Pre-denoises frames that were aligned on what the first pre-denoiser restored: the frames, and the
    /// sigma of their errors, in image units. No gradient goes from sigma to anything but its head.
    ///
    /// # Shapes
    /// - results: `[images, 1, height, width]`
    pub fn predenoise(&self, aligned: &Aligned<Tensor<4>>) -> (Tensor<4>, Tensor<4>) {
        let input = NormalizedInput::new(aligned);
        let (d, features) = self.pre.forward(&input);
        let sigma = self.uncertainty.forward(features.detach(), &input);
        (d, sigma)
    }
}
