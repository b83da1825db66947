//! Preconditioning around the pre-denoised image: inputs and output of unit variance at every timestep
//! (Karras et al. 2022, section 5 and table 1, "EDM", around a known mean).
//!
//! Late in sampling, noise is as small as what the pre-denoiser has left wrong. A network that must find a
//! few hundredths of difference between two images, and give them back, learns little else for a long time.

use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::{DiffusionState, per_image};
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use burn::tensor::Tensor;

/// The largest difference of the previous estimate, in sigmas.
const MAX_PREVIOUS: f32 = 5.0;

/// The largest magnitude of the logarithm of the signal-to-noise ratio.
const MAX_LOG_SNR: f32 = 4.0;

/// The network's diffusion inputs, and how its output becomes an image; `[images, 1, H, W]` each.
///
/// The names follow Karras et al. 2022, table 1.
#[derive(Clone, Debug)]
pub(crate) struct Preconditioned {
    /// The pre-denoised image in [-1, 1]: the mean of what is possible before any noise is seen.
    pub(crate) mean: Tensor<4>,
    /// Sigma of the mean's errors.
    pub(crate) sigma: Tensor<4>,
    /// The noisy image's difference from the noisy mean, in its sigma.
    pub(crate) residual: Tensor<4>,
    /// The previous estimate's difference from the mean in sigmas of the mean's errors; zero where there is
    /// none.
    pub(crate) previous: Tensor<4>,
    /// Half the logarithm of the ratio of the mean's errors to the noise.
    pub(crate) log_snr: Tensor<4>,
    /// Scale of the U-Net's correction: sigma of the remaining error if errors are white.
    pub(crate) c_out: Tensor<4>,
}

impl Preconditioned {
    /// Preconditions a state around `mean`, whose errors have `sigma`; both in [-1, 1].
    pub(crate) fn new(mean: Tensor<4>, sigma: Tensor<4>, state: &DiffusionState) -> Self {
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        let images = mean.dims()[0];
        let each = |values: Vec<f32>| per_image(values, images, &mean.device()).expand(mean.dims());
        let level = |f: fn(f64) -> f64| {
            let value = |&timestep: &usize| f(schedule.alpha_bar(Some(timestep))) as f32;
            each(state.timesteps.iter().map(value).collect())
        };
        let (signal, noise) = (level(f64::sqrt), level(|a| (1.0 - a).sqrt()));
        let flag = state.has_previous_flag().expand(mean.dims());
        let scaled = sigma.clone() * signal.clone();
        let total = (scaled.clone().powi_scalar(2) + noise.clone().powi_scalar(2)).sqrt();
        let previous = (state.x0_prev.clone() - mean.clone()) / sigma.clone();
        let log_snr = (scaled.clone() / noise.clone()).log().clamp(-MAX_LOG_SNR, MAX_LOG_SNR);
        Self {
            residual: (state.x_t.clone() - mean.clone() * signal) / total.clone(),
            previous: previous.clamp(-MAX_PREVIOUS, MAX_PREVIOUS) * flag,
            log_snr: log_snr * 0.5,
            c_out: sigma.clone() * noise / total,
            sigma,
            mean,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use qudi_layers::tensor::read;

    fn image(value: f32) -> Tensor<4> {
        Tensor::full([1, 1, 2, 2], value, &Device::flex())
    }

    fn noisy(timestep: usize, sigma: f32, has_previous: bool) -> Preconditioned {
        let (x_t, x0_prev) = (image(0.5), image(0.3));
        let (has_previous, timesteps) = (vec![has_previous], vec![timestep]);
        let state = DiffusionState { x_t, x0_prev, has_previous, timesteps };
        Preconditioned::new(image(0.2), image(sigma), &state)
    }

    fn first(image: Tensor<4>) -> f32 {
        read(image).unwrap_or_else(|e| panic!("{e}"))[0]
    }

    #[test]
    fn noise_alone_leaves_the_mean_unknown() {
        let noisy = noisy(NUM_TIMESTEPS - 1, 0.1, true);
        assert!((first(noisy.c_out) - 0.1).abs() < 1e-5);
        assert_eq!(first(noisy.log_snr), -2.0);
    }

    #[test]
    fn previous_estimate_is_seen_only_where_it_exists() {
        assert!((first(noisy(100, 0.1, true).previous) - 1.0).abs() < 1e-6);
        assert_eq!(first(noisy(100, 0.001, true).previous), MAX_PREVIOUS);
        assert_eq!(first(noisy(100, 0.1, false).previous), 0.0);
    }
}
