//! How far the pre-denoised frames may be off, pixel by pixel: the deviation of a normal law that fits their errors (Nix and
//! Weigend 1994; Kendall and Gal 2017, section 2.2), from what the pre-denoiser has seen. It changes no frame.

use super::evidence::Evidence;
use super::layers::{Bias, CORRECTION, Conv2d};
use super::resample::unfold;
use crate::config::PreConfig;
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// Logarithms of how much smaller or larger than usual errors can be.
const RANGE: [f32; 2] = [-5.0, 3.0];

/// See the module.
#[derive(Module, Debug)]
pub struct ErrorHead {
    enter: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl PreConfig {
    /// The head, weights zero, if the network has one.
    pub fn init_error(&self, fold: usize, device: &Device) -> Option<ErrorHead> {
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device);
        let width = self.width / 2;
        let head = || ErrorHead {
            enter: conv([self.width, width]),
            out: conv([width, fold * fold]),
            fold,
        };
        self.error.then(head)
    }
}

impl ErrorHead {
    /// Deviation of the errors, in image units, `[images, 1, H, W]`, from the pre-denoiser's `features`.
    pub(super) fn forward(&self, features: Tensor<4>, evidence: &Evidence) -> Tensor<4> {
        let out = self.out.linear(&[self.enter.relu(&[features])]);
        let [least, most] = RANGE;
        unfold(out.clamp(least, most).exp(), self.fold) * evidence.deviation.clone() * CORRECTION
    }
}
