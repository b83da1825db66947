//! The noise schedule of the diffusion, in f64 on the CPU.
//!
//! Cosine schedule of Nichol and Dhariwal (2021), eq. 17: `alpha_bar(t) = f(t) / f(0)`,
//! `f(t) = cos^2((t / T + s) / (1 + s) * pi / 2)`, each step's `beta` at most 0.999.

/// Offset that keeps the first steps from being too small (Nichol and Dhariwal, section 3.2).
const OFFSET: f64 = 0.008;

/// Largest noise share of one step.
const MAX_BETA: f64 = 0.999;

/// The noise levels of the timesteps `0..len`.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseSchedule {
    alpha_bar: Vec<f64>,
}

impl NoiseSchedule {
    /// Returns the cosine schedule over `timesteps` steps.
    pub fn cosine(timesteps: usize) -> Self {
        let f = |t: usize| {
            let angle = (t as f64 / timesteps as f64 + OFFSET) / (1.0 + OFFSET)
                * std::f64::consts::FRAC_PI_2;
            angle.cos().powi(2)
        };
        let mut product = 1.0;
        let alpha_bar = (0..timesteps)
            .map(|t| {
                let beta = (1.0 - f(t + 1) / f(t)).min(MAX_BETA);
                product *= 1.0 - beta;
                product
            })
            .collect();
        Self { alpha_bar }
    }

    /// Returns the number of timesteps.
    pub fn len(&self) -> usize {
        self.alpha_bar.len()
    }

    /// Returns true if there are no timesteps.
    pub fn is_empty(&self) -> bool {
        self.alpha_bar.is_empty()
    }

    /// Returns the share of signal power left at timestep `t`; 1 before the first one (`None`).
    pub fn alpha_bar(&self, t: Option<usize>) -> f64 {
        t.map_or(1.0, |t| self.alpha_bar[t])
    }

    /// Returns the first timestep whose noise has at least this sigma, or the last.
    pub fn timestep_with_noise(&self, sigma: f64) -> usize {
        let timestep = self.alpha_bar.partition_point(|bar| 1.0 - bar < sigma * sigma);
        timestep.min(self.len() - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// tests/golden/generate/schedule.py
    #[test]
    #[allow(clippy::excessive_precision, clippy::unreadable_literal)]
    fn alpha_bar_matches_the_numpy_reference() {
        let schedule = NoiseSchedule::cosine(1000);
        for (t, expected) in include!("../../../../tests/golden/cosine_schedule.in") {
            let got = schedule.alpha_bar(Some(t));
            assert!(
                (got / expected - 1.0).abs() < 1e-9,
                "alpha_bar({t}) = {got}, reference {expected}"
            );
        }
    }

    #[test]
    fn noise_grows_with_the_timestep() {
        let schedule = NoiseSchedule::cosine(1000);
        let levels: Vec<f64> = (0..1000).map(|t| schedule.alpha_bar(Some(t))).collect();
        assert!(levels.windows(2).all(|pair| pair[1] < pair[0]));
        assert!(levels[0] > 0.999 && levels[999] < 1e-4);
    }

    #[test]
    fn timesteps_are_found_by_their_noise() {
        let schedule = NoiseSchedule::cosine(1000);
        for timestep in [0, 50, 500, 999] {
            let noise = (1.0 - schedule.alpha_bar(Some(timestep))).sqrt();
            assert!(schedule.timestep_with_noise(noise).abs_diff(timestep) <= 1);
        }
        assert_eq!([0.0, 2.0].map(|noise| schedule.timestep_with_noise(noise)), [0, 999]);
    }
}
