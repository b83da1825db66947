//! How noisy the linear estimate is, as the sensor's numbers say.

use burn::tensor::Tensor;

/// Place in the sensor's numbers: logarithm of base 10 of the deviation at the mean light.
const AT_MEAN_LIGHT: usize = 10;

/// Least variance: below it, float arithmetic is the noise.
const LEAST: f32 = 1e-8;

/// Variance of the linear estimate's noise at the mean light, `[images, 1, 1, 1]`, from the numbers of every burst's
/// sensor, `[bursts, 11]` (docs/network.md), for its `frames` frames.
pub(super) fn mean_variance(sensor: &Tensor<2>, frames: usize) -> Tensor<4> {
    let [bursts, _] = sensor.dims();
    let deviation = sensor.clone().narrow(1, AT_MEAN_LIGHT, 1).detach();
    let variance = (deviation * (2.0 * std::f32::consts::LN_10)).exp().clamp_min(LEAST);
    variance.repeat_dim(1, frames).reshape([bursts * frames, 1, 1, 1])
}
