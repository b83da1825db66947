//! The timesteps of training and sampling.

use super::schedule::NoiseSchedule;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The number of timesteps in training.
pub const NUM_TIMESTEPS: usize = 1000;

/// Median noise of the log-logistic law: the sigma, in an image from -1 to 1, that hides half of what
/// pre-denoisers usually leave wrong.
const MEDIAN_NOISE: f64 = 0.08;

/// Scale of the log-logistic law: how far the logarithm of the noise lies from its median.
const SCALE: f64 = 0.6;

/// How the timesteps of sampling are spaced.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TimestepSpacing {
    /// Evenly, as in the paper: of ten timesteps one is low enough to show what a good start has left wrong.
    Linear,
    /// By the quantiles of the log-logistic law of training ([`log_logistic_timestep`]), after the noisiest
    /// timestep.
    #[default]
    LogLogistic,
}

/// Returns the timestep at a quantile in (0, 1) of the log-logistic law by which training draws timesteps.
///
/// Most lie where noise is about as large as what pre-denoisers leave wrong: much more noise hides all of
/// that, much less hides nothing.
pub fn log_logistic_timestep(schedule: &NoiseSchedule, quantile: f64) -> usize {
    schedule.timestep_with_noise(MEDIAN_NOISE * (quantile / (1.0 - quantile)).powf(SCALE))
}

/// Returns the timesteps that a sampler of `steps` steps visits, noisiest first, each once, and `None`
/// (clean) at the end.
///
/// These are the last timestep and quantiles of the log-logistic law, or `T s - 1` for `s` from 1 to 0,
/// rounded half to even. `steps` is clamped to `1..=T`.
pub fn sampling_timesteps(
    schedule: &NoiseSchedule,
    steps: usize,
    spacing: TimestepSpacing,
) -> Vec<Option<usize>> {
    let steps = steps.clamp(1, schedule.len());
    let timestep = |i: usize| match spacing {
        _ if i == steps => schedule.len().checked_sub(1),
        _ if i == 0 => None,
        TimestepSpacing::LogLogistic => {
            Some(log_logistic_timestep(schedule, (i as f64 - 0.5) / (steps as f64 - 1.0)))
        }
        TimestepSpacing::Linear => {
            let t = (schedule.len() as f64 * i as f64 / steps as f64 - 1.0).round_ties_even();
            (t >= 0.0).then_some(t as usize)
        }
    };
    let mut timesteps: Vec<_> = (0..=steps).rev().map(timestep).collect();
    timesteps.dedup();
    timesteps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_linear_steps_visit_the_timesteps_of_the_paper() {
        let schedule = NoiseSchedule::cosine(1000);
        let expected: Vec<_> = [999, 899, 799, 699, 599, 499, 399, 299, 199, 99]
            .map(Some)
            .into_iter()
            .chain([None])
            .collect();
        assert_eq!(sampling_timesteps(&schedule, 10, TimestepSpacing::Linear), expected);
        for spacing in [TimestepSpacing::Linear, TimestepSpacing::LogLogistic] {
            assert_eq!(sampling_timesteps(&schedule, 1, spacing), [Some(999), None]);
        }
        assert_eq!(sampling_timesteps(&schedule, 5000, TimestepSpacing::Linear).len(), 1001);
    }

    #[test]
    fn log_logistic_timesteps_are_dense_at_little_noise() {
        let schedule = NoiseSchedule::cosine(1000);
        let expected: Vec<_> = [999, 282, 128, 83, 59, 44, 31, 22, 13, 4]
            .map(Some)
            .into_iter()
            .chain([None])
            .collect();
        assert_eq!(sampling_timesteps(&schedule, 10, TimestepSpacing::LogLogistic), expected);
        assert_eq!(
            sampling_timesteps(&schedule, 2, TimestepSpacing::LogLogistic),
            [Some(999), Some(44), None]
        );
        // Of a thousand many would be the same.
        let all = sampling_timesteps(&schedule, 1000, TimestepSpacing::LogLogistic);
        assert!(all.windows(2).all(|pair| pair[0] > pair[1]), "{all:?}");
    }
}
