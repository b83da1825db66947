//! What merged counts tell of the ratios of colours to luma.
//!
//! A pixel behind a colour sees light of luma `L` times a ratio `r`. Around an expected ratio `e` its count
//! has a mean of nearly `m(L e) + L m'(L e) (r - e)`. So the sum of `count - m(L e) + L m'(L e) e` over some
//! pixels, divided by the sum of `L m'(L e)`, is their ratio, however much their luma differs and the counts
//! saturate: a step of Newton's method.

use super::guided::gaussian;
use super::{CountResponse, MergedColours};

/// Least sum of slopes, in units of one pixel's at a luma of 1, that tells a ratio.
const MIN_SLOPE: f32 = 1e-5;

/// Merged counts, made linear in the ratios of colours to luma.
pub(super) struct Evidence {
    /// Counts, less what does not depend on the ratio.
    pub(super) counts: [Vec<f32>; 3],
    /// Counts for each unit of the ratio.
    pub(super) slopes: [Vec<f32>; 3],
    /// Variances of the counts.
    pub(super) variances: [Vec<f32>; 3],
}

impl Evidence {
    /// Makes merged counts linear around ratios of sensor colours to luma.
    pub(super) fn new(
        merged: &MergedColours,
        response: &CountResponse,
        luma: &[f32],
        ratios: &[Vec<f32>; 3],
    ) -> Self {
        let zeros = || std::array::from_fn(|_| vec![0.0; luma.len()]);
        let mut evidence = Self { counts: zeros(), slopes: zeros(), variances: zeros() };
        for (k, ratios) in ratios.iter().enumerate() {
            let (counts, weights) = (&merged.counts[k], &merged.weights[k]);
            for (i, (&ratio, &luma)) in ratios.iter().zip(luma).enumerate() {
                let weight = weights[i];
                if weight > 0.0 {
                    let expected = response.at(ratio * luma, response.dark);
                    let slope = weight * luma * expected.slope;
                    evidence.counts[k][i] = counts[i] - weight * expected.mean + slope * ratio;
                    evidence.slopes[k][i] = slope;
                    evidence.variances[k][i] = weight * expected.variance;
                }
            }
        }
        evidence
    }

    /// Returns the ratio of one colour over all counts around every pixel; `otherwise` where there are none.
    pub(super) fn around(
        &self,
        merged: &MergedColours,
        response: &CountResponse,
        colour: usize,
        sigma: f32,
        otherwise: &[f32],
    ) -> Vec<f32> {
        let counts = gaussian(&self.counts[colour], merged.size, sigma);
        let slopes = gaussian(&self.slopes[colour], merged.size, sigma);
        let least = MIN_SLOPE * response.per_unit;
        let ratio = |((&count, &slope), &otherwise): ((&f32, &f32), &f32)| {
            if slope < least { otherwise } else { (count / slope).max(0.0) }
        };
        counts.iter().zip(&slopes).zip(otherwise).map(ratio).collect()
    }

    /// Returns the ratio of one colour over the whole frame.
    pub(super) fn mean(&self, colour: usize) -> f32 {
        let sum = |values: &[f32]| values.iter().map(|&value| f64::from(value)).sum::<f64>();
        let slopes = sum(&self.slopes[colour]).max(f64::from(f32::MIN_POSITIVE));
        (sum(&self.counts[colour]) / slopes).max(0.0) as f32
    }
}
