//! The predicted uncertainty of the pre-denoised frames: sigma of a normal law that fits their errors pixel
//! by pixel (Nix and Weigend 1994; Kendall and Gal 2017, section 2.2). It changes no frame.

use super::CORRECTION;
use super::config::RegressionConfig;
use super::input::NormalizedInput;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::pixel_shuffle;
use qudi_layers::{Bias, Conv2d};

/// The range of the logarithm of how much smaller or larger than usual errors can be.
const LOG_RANGE: [f32; 2] = [-5.0, 3.0];

/// The layers that predict the uncertainty from the pre-denoiser's features.
#[derive(Module, Debug)]
pub(crate) struct UncertaintyHead {
    enter: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl RegressionConfig {
    /// Creates the head, all weights zero.
    pub(crate) fn init_uncertainty(&self, device: &Device) -> UncertaintyHead {
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device);
        let width = self.width / 2;
        UncertaintyHead {
            enter: conv([self.width, width]),
            out: conv([width, self.fold * self.fold]),
            fold: self.fold,
        }
    }
}

impl UncertaintyHead {
    /// Predicts the sigma of the errors in image units, `[images, 1, H, W]`, from the pre-denoiser's
    /// `features`.
    pub(crate) fn forward(&self, features: Tensor<4>, input: &NormalizedInput) -> Tensor<4> {
        let out = self.out.linear(&[self.enter.relu(&[features])]);
        let [least, most] = LOG_RANGE;
        let factor = pixel_shuffle(out.clamp(least, most).exp(), self.fold);
        factor * input.sigma.clone() * CORRECTION
    }
}
