//! Mean, confidence interval and worst case of a few values.

/// Mean of some values with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Statistics {
    /// The number of values.
    pub n: usize,
    /// Arithmetic mean.
    pub mean: f64,
    /// Half width of the 95 % confidence interval (Student); `None` for a single value.
    pub ci95: Option<f64>,
    /// The value that 5 % lie below (the lowest of fewer than 20).
    pub worst5: f64,
}

/// Two-sided 95 % quantiles of Student's distribution for 1 to 30 degrees of freedom.
const STUDENT_QUANTILES: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160,
    2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056,
    2.052, 2.048, 2.045, 2.042,
];

/// The 97.5 % quantile of the normal distribution, for more degrees of freedom.
const NORMAL_QUANTILE: f64 = 1.96;

impl Statistics {
    /// Computes the statistics of `values`; `None` if there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len();
        if n == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n as f64;
        let ci95 = (n > 1).then(|| {
            let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
            let error = (squares / (n - 1) as f64 / n as f64).sqrt();
            STUDENT_QUANTILES.get(n - 2).copied().unwrap_or(NORMAL_QUANTILE) * error
        });
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Self { n, mean, ci95, worst5: sorted[n / 20] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_intervals_follow_student() {
        // scipy.stats.t.interval(0.95, 3, 2.5, sem([1, 2, 3, 4])) is (0.4457, 4.5543).
        let of = Statistics::of(&[1.0, 2.0, 3.0, 4.0]).unwrap();
        assert_eq!((of.n, of.mean, of.worst5), (4, 2.5, 1.0));
        assert!((of.ci95.unwrap() - 2.0543).abs() < 1e-3);
        assert_eq!(Statistics::of(&[3.0]).unwrap().ci95, None);
        assert!(Statistics::of(&[]).is_none());
        let many: Vec<f64> = (0..100).map(f64::from).collect();
        assert_eq!(Statistics::of(&many).unwrap().worst5, 5.0);
    }
}
