//! The timesteps that the network learns at.

use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::timesteps::{NUM_TIMESTEPS, log_logistic_timestep};
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
    /// Returns the timestep at a quantile in [0, 1).
    pub fn timestep(self, quantile: f64) -> usize {
        match self {
            Self::Uniform => ((quantile * NUM_TIMESTEPS as f64) as usize).min(NUM_TIMESTEPS - 1),
            Self::LogLogistic => {
                log_logistic_timestep(&NoiseSchedule::cosine(NUM_TIMESTEPS), quantile)
            }
        }
    }
}

/// Returns the timestep of the estimate before `timestep`: noisier by a tenth of all timesteps, on the scale
/// of their roots.
pub(in crate::learner) fn previous_timestep(timestep: usize) -> usize {
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
}
