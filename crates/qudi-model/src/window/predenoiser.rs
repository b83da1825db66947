//! The pre-denoiser: every frame alone.

use super::config::WindowConfig;
use super::hourglass::{Hourglass, ImageHead, Pyramid};
use super::input::Measurement;
use crate::sensor::SENSOR_NUMBERS;
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// Planes of the linear estimate and of the counts at half the resolution.
const MEASURED: usize = 8;

/// Restores single frames.
#[derive(Module, Debug)]
pub(super) struct PreDenoiser {
    hourglass: Hourglass,
    head: ImageHead,
}

impl WindowConfig {
    pub(super) fn init_predenoiser(&self, device: &Device) -> PreDenoiser {
        PreDenoiser {
            hourglass: Hourglass::zeros(
                MEASURED + SENSOR_NUMBERS,
                0,
                self.widths,
                self.coarse_entry(),
                device,
            ),
            head: ImageHead::zeros(self.widths[0], device),
        }
    }
}

impl PreDenoiser {
    /// Restores frames, `[images, 1, H, W]` in image units, and computes their features.
    pub(super) fn forward(&self, measurement: &Measurement) -> (Tensor<4>, Pyramid) {
        let [images, _, h, w] = measurement.planes.dims();
        let sensor = measurement.sensor.clone().expand([images, SENSOR_NUMBERS, h, w]);
        let features = self.hourglass.forward(&[measurement.planes.clone(), sensor], None);
        (self.head.forward(features[0].clone()) + measurement.local_mean.clone(), features)
    }
}
