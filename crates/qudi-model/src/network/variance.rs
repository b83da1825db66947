//! How noisy the linear estimate is, as the sensor's numbers say.

use super::resample::mean_around;
use burn::tensor::Tensor;

/// Places in the sensor's numbers.
const EXPOSURE: usize = 1;
const AT_NO_LIGHT: usize = 9;
const AT_MEAN_LIGHT: usize = 10;

/// Least variance: below it, float arithmetic is the noise.
const LEAST: f32 = 1e-8;

/// Variance of the linear estimate `u`, affine in the light: that of shot noise is.
pub(super) struct Variance {
    /// At no light, `[images, 1, 1, 1]`.
    floor: Tensor<4>,
    /// At the mean light.
    mean: Tensor<4>,
    /// The image's value at the mean light.
    exposure: Tensor<4>,
}

impl Variance {
    /// From the numbers of every burst's sensor, `[bursts, 11]` (docs/network.md), for its `frames` frames.
    pub fn of(sensor: &Tensor<2>, frames: usize) -> Self {
        let bursts = sensor.dims()[0];
        let images = |numbers: Tensor<2>| {
            numbers.repeat_dim(1, frames).reshape([bursts * frames, 1, 1, 1]).detach()
        };
        let number = |place| sensor.clone().narrow(1, place, 1);
        // Logarithms of base 10 of the deviation.
        let square = |place| (number(place) * (2.0 * std::f32::consts::LN_10)).exp();
        Self {
            floor: images(square(AT_NO_LIGHT)),
            mean: images(square(AT_MEAN_LIGHT)),
            exposure: images(number(EXPOSURE)),
        }
    }

    /// At the mean light, `[images, 1, 1, 1]`.
    pub fn mean(&self) -> Tensor<4> {
        self.mean.clone().clamp_min(LEAST)
    }

    /// At every pixel of `image`, the light's own estimate, `[images, 1, H, W]`, averaged over 5 x 5.
    pub fn at(&self, image: Tensor<4>) -> Tensor<4> {
        let slope =
            (self.mean.clone() - self.floor.clone()) / self.exposure.clone().clamp_min(1e-3);
        let variance = mean_around(image.detach(), 2) * slope + self.floor.clone();
        variance.clamp_min(LEAST)
    }
}
