//! From noise to a picture in a few steps: DDIM (Song et al. 2021) and ancestral sampling (Ho et al. 2020).
//!
//! The network predicts the clean image `x0`; what a step makes of it is a weighted sum, so that samplers are
//! lists of weights.

use crate::diffusion::schedule::{NoiseSchedule, Spacing};

/// Diffusion times of training.
pub const TIMES: usize = 1000;

/// How noise leaves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Sampler {
    /// Without fresh noise (eta 0).
    #[default]
    Ddim,
    /// With the noise of the posterior.
    Ancestral,
}

/// One reverse step: `x <- x0 * clean + x * noisy + sigma * noise`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Number, from 1.
    pub number: usize,
    /// Diffusion time of `x`.
    pub time: usize,
    /// Weight of the prediction.
    pub clean: f64,
    /// Weight of the image so far.
    pub noisy: f64,
    /// Deviation of fresh noise.
    pub sigma: f64,
}

impl Sampler {
    /// The reverse steps, first to last: `count`, taken into `1..=1000`, or fewer where their times would be the same. After
    /// the last, `x` is the prediction.
    pub fn steps(self, schedule: &NoiseSchedule, count: usize, spacing: Spacing) -> Vec<Step> {
        let times = schedule.sampling_times(count, spacing);
        let pairs = times.windows(2).enumerate();
        pairs
            .filter_map(|(i, pair)| {
                let time = pair[0]?;
                let now = schedule.alpha_bar(Some(time));
                let next = schedule.alpha_bar(pair[1]);
                let (clean, noisy, sigma) = match self {
                    Self::Ddim => {
                        let noisy = ((1.0 - next) / (1.0 - now)).sqrt();
                        (next.sqrt() - noisy * now.sqrt(), noisy, 0.0)
                    }
                    Self::Ancestral => {
                        let beta = 1.0 - now / next;
                        let clean = next.sqrt() * beta / (1.0 - now);
                        let noisy = (now / next).sqrt() * (1.0 - next) / (1.0 - now);
                        (clean, noisy, (beta * (1.0 - next) / (1.0 - now)).sqrt())
                    }
                };
                Some(Step { number: i + 1, time, clean, noisy, sigma })
            })
            .collect()
    }
}

impl Step {
    /// The image after the step; `x0` is cut to [-1, 1] before anything is derived from it.
    pub fn advance(&self, x: &mut [f32], x0: &[f32], mut noise: impl Iterator<Item = f32>) {
        let (clean, noisy, sigma) = (self.clean as f32, self.noisy as f32, self.sigma as f32);
        for (x, &x0) in x.iter_mut().zip(x0) {
            *x = x0.clamp(-1.0, 1.0) * clean + *x * noisy;
            if sigma > 0.0 {
                *x += sigma * noise.next().unwrap_or_default();
            }
        }
    }
}
