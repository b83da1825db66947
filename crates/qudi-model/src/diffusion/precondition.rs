//! The diffusion's images around the pre-denoised one, in numbers of unit variance at every diffusion time (Karras et al. 2022,
//! section 5 and table 1, "EDM", around a mean that is known).
//!
//! Late in sampling, noise is as small as what the pre-denoiser has left wrong. A network that must tell a few hundredths of
//! difference between two images, and give them back, learns little else for a long time.

use crate::diffusion::sampler::TIMES;
use crate::diffusion::schedule::NoiseSchedule;
use crate::network::State;
use burn::tensor::Tensor;

/// Most errors that the previous estimate's difference counts.
const MOST: f32 = 5.0;

/// Most of the logarithm of how clear the noisy image is.
const CLEAREST: f32 = 4.0;

/// A noisy image and the estimate before it, `[images, 1, H, W]` each.
#[derive(Clone, Debug)]
pub(crate) struct Preconditioned {
    /// The pre-denoised image in [-1, 1].
    pub(crate) base: Tensor<4>,
    /// The noisy image's difference from what the pre-denoised one would be at this time, in deviations.
    pub(crate) residual: Tensor<4>,
    /// The previous estimate's difference from the pre-denoised image in deviations of its errors; zero where there is none.
    pub(crate) earlier: Tensor<4>,
    /// Half the logarithm of how large those errors are beside the noise.
    pub(crate) clarity: Tensor<4>,
    /// What the prediction takes of the residual.
    known: Tensor<4>,
    /// What it takes of the correction: the deviation of what is still unknown if errors are white.
    pub(crate) unknown: Tensor<4>,
}

impl Preconditioned {
    /// Of a state; `error` the deviation of the errors of `base`, both in [-1, 1].
    pub(crate) fn new(base: Tensor<4>, error: Tensor<4>, state: &State) -> Self {
        let schedule = NoiseSchedule::cosine(TIMES);
        let images = base.dims()[0];
        let bursts = state.times.len();
        let each = |values: Vec<f32>| {
            let values = Tensor::<1>::from_floats(values.as_slice(), &base.device());
            let values = values.reshape([bursts, 1]).repeat_dim(1, images / bursts);
            values.reshape([images, 1, 1, 1]).expand(base.dims())
        };
        let level = |f: fn(f64) -> f64| {
            let value = |&time: &usize| f(schedule.alpha_bar(Some(time))) as f32;
            each(state.times.iter().map(value).collect())
        };
        let (signal, noise) = (level(f64::sqrt), level(|a| (1.0 - a).sqrt()));
        let flag = each(state.known.iter().map(|&known| f32::from(u8::from(known))).collect());
        let left = error.clone() * signal.clone();
        let scale = (left.clone().powi_scalar(2) + noise.clone().powi_scalar(2)).sqrt();
        let earlier = (state.x0_prev.clone() - base.clone()) / error.clone();
        let clarity = (left.clone() / noise.clone()).log().clamp(-CLEAREST, CLEAREST);
        Self {
            residual: (state.x_t.clone() - base.clone() * signal) / scale.clone(),
            earlier: earlier.clamp(-MOST, MOST) * flag,
            clarity: clarity * 0.5,
            known: error.clone() * left / scale.clone(),
            unknown: error * noise / scale,
            base,
        }
    }

    /// The clean image in [-1, 1]: what is expected if errors of the pre-denoised image were white, and a `correction`.
    pub(crate) fn prediction(self, correction: Tensor<4>) -> Tensor<4> {
        self.base + self.residual * self.known + correction * self.unknown
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

    fn noisy(time: usize, error: f32, known: bool) -> Preconditioned {
        let (x_t, x0_prev) = (image(0.5), image(0.3));
        let state = State { x_t, x0_prev, known: vec![known], times: vec![time] };
        Preconditioned::new(image(0.2), image(error), &state)
    }

    fn first(image: Tensor<4>) -> f32 {
        read(image).unwrap_or_else(|e| panic!("{e}"))[0]
    }

    fn prediction(time: usize, error: f32, correction: f32) -> f32 {
        first(noisy(time, error, true).prediction(image(correction)))
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
        assert_eq!(first(noisy(TIMES - 1, 0.1, true).clarity), -2.0);
    }

    #[test]
    fn an_estimate_is_seen_only_where_there_is_one() {
        assert!((first(noisy(100, 0.1, true).earlier) - 1.0).abs() < 1e-6);
        assert_eq!(first(noisy(100, 0.001, true).earlier), MOST);
        assert_eq!(first(noisy(100, 0.1, false).earlier), 0.0);
    }
}
