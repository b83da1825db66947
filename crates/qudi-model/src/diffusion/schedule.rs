//! The noise schedule of the diffusion, in f64 on the CPU.
//!
//! Cosine schedule of Nichol and Dhariwal (2021), eq. 17: `alpha_bar(t) = f(t) / f(0)`,
//! `f(t) = cos^2((t / T + s) / (1 + s) * pi / 2)`, each step's `beta` at most 0.999.

/// Offset that keeps the first steps from being too small (Nichol and Dhariwal, section 3.2).
const OFFSET: f64 = 0.008;

/// Largest noise share of one step.
const MAX_BETA: f64 = 0.999;

/// Deviation of the noise, in an image from -1 to 1, that hides half of what pre-denoisers usually leave wrong.
const NOISE: f64 = 0.08;

/// How far times lie from that one: the scale of the logarithm of their noise.
const SPREAD: f64 = 0.6;

/// How the times of sampling lie.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spacing {
    /// Evenly, as in the paper: of ten times one is low enough to show what a good start has left wrong.
    Linear,
    /// As densely as training draws them ([`NoiseSchedule::time_at`]), after the first.
    #[default]
    Learnt,
}

/// Noise levels of the diffusion times `0..len`.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseSchedule {
    alpha_bar: Vec<f64>,
}

impl NoiseSchedule {
    /// The cosine schedule over `times` steps.
    pub fn cosine(times: usize) -> Self {
        let f = |t: usize| {
            let angle =
                (t as f64 / times as f64 + OFFSET) / (1.0 + OFFSET) * std::f64::consts::FRAC_PI_2;
            angle.cos().powi(2)
        };
        let mut product = 1.0;
        let alpha_bar = (0..times)
            .map(|t| {
                let beta = (1.0 - f(t + 1) / f(t)).min(MAX_BETA);
                product *= 1.0 - beta;
                product
            })
            .collect();
        Self { alpha_bar }
    }

    /// Number of diffusion times.
    pub fn len(&self) -> usize {
        self.alpha_bar.len()
    }

    /// Whether there are no times at all.
    pub fn is_empty(&self) -> bool {
        self.alpha_bar.is_empty()
    }

    /// Share of signal power left at time `t`; 1 before the first time (`None`).
    pub fn alpha_bar(&self, t: Option<usize>) -> f64 {
        t.map_or(1.0, |t| self.alpha_bar[t])
    }

    /// The first time whose noise has at least this deviation, or the last.
    pub fn time_of(&self, noise: f64) -> usize {
        let time = self.alpha_bar.partition_point(|bar| 1.0 - bar < noise * noise);
        time.min(self.len() - 1)
    }

    /// The time at a place in (0, 1) of the log-logistic law by which training draws times: most where noise is about as
    /// large as what pre-denoisers leave wrong. In much more noise all of that is hidden, in much less nothing is.
    pub fn time_at(&self, place: f64) -> usize {
        self.time_of(NOISE * (place / (1.0 - place)).powf(SPREAD))
    }

    /// The times that a sampler with `steps` steps visits, last first, and `None` (clean) at the
    /// end, each once: the last and quantiles of their law, or `T s - 1` for `s` from 1 to 0, rounded half to even.
    /// `steps` is taken into `1..=T`.
    pub fn sampling_times(&self, steps: usize, spacing: Spacing) -> Vec<Option<usize>> {
        let steps = steps.clamp(1, self.len());
        let time = |i: usize| match spacing {
            _ if i == steps => self.len().checked_sub(1),
            _ if i == 0 => None,
            Spacing::Learnt => Some(self.time_at((i as f64 - 0.5) / (steps as f64 - 1.0))),
            Spacing::Linear => {
                let t = (self.len() as f64 * i as f64 / steps as f64 - 1.0).round_ties_even();
                (t >= 0.0).then_some(t as usize)
            }
        };
        let mut times: Vec<_> = (0..=steps).rev().map(time).collect();
        times.dedup();
        times
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// tests/golden/generate/schedule.py
    #[test]
    #[allow(clippy::excessive_precision, clippy::unreadable_literal)]
    fn alpha_bar_is_that_of_the_numpy_reference() {
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
    fn noise_only_grows() {
        let schedule = NoiseSchedule::cosine(1000);
        let levels: Vec<f64> = (0..1000).map(|t| schedule.alpha_bar(Some(t))).collect();
        assert!(levels.windows(2).all(|pair| pair[1] < pair[0]));
        assert!(levels[0] > 0.999 && levels[999] < 1e-4);
    }

    #[test]
    fn times_are_found_by_their_noise() {
        let schedule = NoiseSchedule::cosine(1000);
        for time in [0, 50, 500, 999] {
            let noise = (1.0 - schedule.alpha_bar(Some(time))).sqrt();
            assert!(schedule.time_of(noise).abs_diff(time) <= 1);
        }
        assert_eq!([0.0, 2.0].map(|noise| schedule.time_of(noise)), [0, 999]);
    }

    #[test]
    fn ten_steps_visit_the_papers_times() {
        let schedule = NoiseSchedule::cosine(1000);
        let expected: Vec<_> = [999, 899, 799, 699, 599, 499, 399, 299, 199, 99]
            .map(Some)
            .into_iter()
            .chain([None])
            .collect();
        assert_eq!(schedule.sampling_times(10, Spacing::Linear), expected);
        for spacing in [Spacing::Linear, Spacing::Learnt] {
            assert_eq!(schedule.sampling_times(1, spacing), [Some(999), None]);
        }
        assert_eq!(schedule.sampling_times(5000, Spacing::Linear).len(), 1001);
    }

    #[test]
    fn learnt_times_are_dense_where_noise_is_little() {
        let schedule = NoiseSchedule::cosine(1000);
        let expected: Vec<_> = [999, 282, 128, 83, 59, 44, 31, 22, 13, 4]
            .map(Some)
            .into_iter()
            .chain([None])
            .collect();
        assert_eq!(schedule.sampling_times(10, Spacing::Learnt), expected);
        assert_eq!(schedule.sampling_times(2, Spacing::Learnt), [Some(999), Some(44), None]);
        // Of a thousand many would be the same.
        let all = schedule.sampling_times(1000, Spacing::Learnt);
        assert!(all.windows(2).all(|pair| pair[0] > pair[1]), "{all:?}");
    }
}
