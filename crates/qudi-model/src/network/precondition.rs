//! The noisy image around the pre-denoised one, in numbers of unit variance at every diffusion time (Karras et al. 2022, section
//! 5 and table 1, "EDM", around a mean that is known).
//!
//! Late in sampling, noise is as small as what the pre-denoiser has left wrong. A network that must tell a few hundredths of
//! difference between two images, and give them back, learns little else for a long time.

use super::layers::CORRECTION;
use crate::sampler::TIMES;
use crate::schedule::NoiseSchedule;
use burn::tensor::Tensor;

/// A noisy image `x_t`, `[images, 1, H, W]`.
pub(super) struct Preconditioned {
    /// Its difference from what the pre-denoised image would be at this time, in deviations.
    pub(super) residual: Tensor<4>,
    /// The pre-denoised image in [-1, 1], and the deviation of its errors.
    base: Tensor<4>,
    error: Tensor<4>,
    /// What the prediction takes of the residual, and of the correction, in units of the error.
    known: Tensor<4>,
    unknown: Tensor<4>,
}

impl Preconditioned {
    /// Of an image at `times`, one for each burst; `deviation` that of the merged image's noise, in image units.
    pub(super) fn new(
        base: Tensor<4>,
        x_t: Tensor<4>,
        deviation: &Tensor<4>,
        times: &[usize],
    ) -> Self {
        let schedule = NoiseSchedule::cosine(TIMES);
        let images = base.dims()[0];
        let levels = |f: fn(f64) -> f64| {
            let value = |&time: &usize| f(schedule.alpha_bar(Some(time))) as f32;
            let values: Vec<f32> = times.iter().map(value).collect();
            let values = Tensor::<1>::from_floats(values.as_slice(), &base.device());
            let frames = images / times.len();
            let values = values.reshape([times.len(), 1]).repeat_dim(1, frames);
            values.reshape([images, 1, 1, 1]).expand(base.dims())
        };
        let (signal, noise) = (levels(f64::sqrt), levels(|a| (1.0 - a).sqrt()));
        // A deviation spans twice as much in [-1, 1].
        let error = deviation.clone() * (2.0 * CORRECTION);
        let left = error.clone() * signal.clone();
        let scale = (left.clone().powi_scalar(2) + noise.clone().powi_scalar(2)).sqrt();
        Self {
            residual: (x_t - base.clone() * signal) / scale.clone(),
            known: left / scale.clone(),
            unknown: noise / scale,
            base,
            error,
        }
    }

    /// The clean image in [-1, 1]: what is expected if errors of the pre-denoised image were white, and a `correction`.
    pub(super) fn prediction(self, correction: Tensor<4>) -> Tensor<4> {
        let Self { residual, base, error, known, unknown } = self;
        base + error * (residual * known + correction * unknown)
    }
}
