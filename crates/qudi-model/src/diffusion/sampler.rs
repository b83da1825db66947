//! From noise to a picture in a few steps: DDIM (Song et al. 2021) and ancestral sampling (Ho et al. 2020).
//!
//! The network predicts the clean image `x0`; what a step makes of it is a weighted sum, so that samplers are
//! lists of weights.

use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::timesteps::{TimestepSpacing, sampling_timesteps};

/// The kind of sampler.
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
    /// The number of the step, from 1.
    pub number: usize,
    /// The timestep of `x`.
    pub timestep: usize,
    /// The weight of the prediction.
    pub clean: f64,
    /// The weight of the image so far.
    pub noisy: f64,
    /// Sigma of fresh noise.
    pub sigma: f64,
}

impl Sampler {
    /// Returns the reverse steps, first to last: `count`, clamped to `1..=1000`, or fewer where their
    /// timesteps would be the same. After the last one, `x` is the prediction.
    pub fn steps(
        self,
        schedule: &NoiseSchedule,
        count: usize,
        spacing: TimestepSpacing,
    ) -> Vec<Step> {
        let timesteps = sampling_timesteps(schedule, count, spacing);
        let pairs = timesteps.windows(2).enumerate();
        pairs
            .filter_map(|(i, pair)| {
                let timestep = pair[0]?;
                let now = schedule.alpha_bar(Some(timestep));
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
                Some(Step { number: i + 1, timestep, clean, noisy, sigma })
            })
            .collect()
    }
}

impl Step {
    /// Replaces `x` by the image after the step; `x0` is clamped to [-1, 1] before anything is derived from
    /// it.
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

/// Samples a clean image in [-1, 1] from the noise `x`.
///
/// `predict` gives the clean image from a step, the noisy image and the previous prediction, which is zero at
/// the first step. `noise` gives the fresh noise of a step.
///
/// # Errors
/// Those of `predict` and `noise`.
pub fn sample<E>(
    steps: &[Step],
    mut x: Vec<f32>,
    mut predict: impl FnMut(&Step, &[f32], &[f32]) -> Result<Vec<f32>, E>,
    noise: impl Fn(&Step) -> Result<Vec<f32>, E>,
) -> Result<Vec<f32>, E> {
    let mut x0 = vec![0.0; x.len()];
    for step in steps {
        x0 = predict(step, &x, &x0)?;
        step.advance(&mut x, &x0, noise(step)?.into_iter());
    }
    Ok(x0)
}
