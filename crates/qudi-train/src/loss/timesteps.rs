//! The timesteps that the network learns at.

use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::timesteps::{
    NUM_TIMESTEPS, TimestepSpacing, log_logistic_timestep, sampling_timesteps,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The law of the timesteps that the network learns at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TimestepLaw {
    /// All alike (Ho et al. 2020, algorithm 1), as in the paper.
    Uniform,
    /// Most where noise is about as large as what pre-denoisers leave wrong ([`log_logistic_timestep`]).
    #[default]
    LogLogistic,
}

impl TimestepLaw {
    /// The timestep at a quantile in [0, 1).
    pub fn timestep(self, quantile: f64) -> usize {
        match self {
            Self::Uniform => ((quantile * NUM_TIMESTEPS as f64) as usize).min(NUM_TIMESTEPS - 1),
            Self::LogLogistic => {
                log_logistic_timestep(&NoiseSchedule::cosine(NUM_TIMESTEPS), quantile)
            }
        }
    }
}

/// What the noise of the noisy images is added to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseOn {
    /// The true images (Ho et al. 2020, algorithm 1): the network learns the mean of what noise leaves open.
    #[default]
    Truth,
    /// The network's own first estimate, as in later steps of sampling: it learns to draw what the loss asks for from
    /// what it is given when it is used, which shows nothing of the truth. The timestep is that of the second of two
    /// steps, or, with [`TimestepLaw::Uniform`], any.
    Estimate,
}

/// The timestep of the second of two steps of sampling.
pub(crate) fn second_of_two(spacing: TimestepSpacing) -> usize {
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    sampling_timesteps(&schedule, 2, spacing).into_iter().flatten().last().unwrap_or_default()
}

/// The timestep of the estimate before `timestep`: noisier by a tenth of all timesteps, on the scale of their
/// roots.
pub(super) fn previous_timestep(timestep: usize) -> usize {
    let all = NUM_TIMESTEPS as f64;
    let share = ((timestep + 1) as f64 / all).sqrt() + 0.1;
    ((all * share * share).round() as usize - 1).min(NUM_TIMESTEPS - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_timesteps_are_all_alike() {
        let timestep = |quantile| TimestepLaw::Uniform.timestep(quantile);
        assert_eq!([0.0, 0.25, 0.5, 0.9999].map(timestep), [0, 250, 500, 999]);
        assert!(TimestepLaw::LogLogistic.timestep(0.5) < 100);
    }

    #[test]
    fn second_of_two_steps_depends_on_their_spacing() {
        let spacings = [TimestepSpacing::Linear, TimestepSpacing::LogLogistic];
        assert_eq!(spacings.map(second_of_two), [499, 44]);
    }
}
