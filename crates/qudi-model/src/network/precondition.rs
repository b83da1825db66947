//! The noisy image around the pre-denoised one, in numbers of unit variance at every diffusion time (Karras et al. 2022, section
//! 5 and table 1, "EDM", around a mean that is known).
//!
//! Late in sampling, noise is as small as what the pre-denoiser has left wrong. A network that must tell a few hundredths of
//! difference between two images, and give them back, learns little else for a long time.

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
    /// Of an image at `times`, one for each burst; `error` the deviation of the errors of `base`, both in [-1, 1].
    pub(super) fn new(base: Tensor<4>, x_t: Tensor<4>, error: Tensor<4>, times: &[usize]) -> Self {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::read;
    use burn::tensor::Device;

    fn image(value: f32) -> Tensor<4> {
        Tensor::full([1, 1, 2, 2], value, &Device::flex())
    }

    fn prediction(time: usize, error: f32, correction: f32) -> f32 {
        let noisy = Preconditioned::new(image(0.2), image(0.5), image(error), &[time]);
        read(noisy.prediction(image(correction))).unwrap_or_else(|e| panic!("{e}"))[0]
    }

    /// Bayes' rule for a normal prior around the pre-denoised image and normal noise.
    #[test]
    fn what_is_expected_without_a_correction_is_the_posterior_mean() {
        let schedule = NoiseSchedule::cosine(TIMES);
        for (time, error) in [(20, 0.1), (50, 0.05), (300, 0.3)] {
            let signal = schedule.alpha_bar(Some(time));
            let (prior, noise) = (1.0 / (error * error), signal / (1.0 - signal));
            let expected = (prior * 0.2 + noise * 0.5 / signal.sqrt()) / (prior + noise);
            let got = f64::from(prediction(time, error as f32, 0.0));
            assert!((got - expected).abs() < 1e-6, "{got} and {expected} at {time}");
        }
    }

    #[test]
    fn noise_alone_says_nothing() {
        assert!((prediction(TIMES - 1, 0.1, 0.5) - (0.2 + 0.1 * 0.5)).abs() < 1e-5);
    }
}
