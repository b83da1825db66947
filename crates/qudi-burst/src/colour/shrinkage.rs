//! Averages of chroma, drawn to the ones of wider surroundings where their noise explains the difference.
//!
//! An average differs from its surroundings by noise of known variance `v`, and by colour. The variance `s`
//! of the colours is estimated around every pixel as what the differences have beyond noise; `s / (s + v)` of
//! a difference is then kept (empirical Bayes). Dark and even areas keep little, edges of colour all.

use super::chroma::Colours;
use super::guided::{Averages, gaussian};
use super::{Evidence, MergedColours};
use qudi_core::Size;

/// Width of the surroundings, in units of the width of the averages.
const WIDTH: f32 = 3.0;

/// Least variance.
const MIN_VARIANCE: f32 = 1e-9;

impl Colours<'_> {
    /// Draws ratios to the ones of their surroundings, and these to the ones of the whole frame.
    pub(super) fn shrunk(
        &self,
        merged: &MergedColours,
        evidence: &Evidence,
        averages: Averages,
    ) -> Averages {
        let size = merged.size;
        let sigma = WIDTH * self.sigma;
        let Averages { mut ratios, mut variances } = averages;
        for k in 0..3 {
            let mut wide = evidence.around(merged, self.response, k, sigma, &ratios[k]);
            let mean = evidence.mean(k);
            let mut noise = gaussian(&variances[k], size, sigma);
            for noise in &mut noise {
                *noise /= WIDTH * WIDTH;
            }
            let excess = Excess::new(&wide, |_| mean, &noise);
            let spread = excess.of_frame();
            shrink(&mut wide, &mut noise, |_| mean, |_| spread);
            let excess = Excess::new(&ratios[k], |i| wide[i], &variances[k]);
            let spread = excess.around(size, sigma);
            shrink(&mut ratios[k], &mut variances[k], |i| wide[i], |i| spread[i]);
            for (variance, noise) in variances[k].iter_mut().zip(&noise) {
                *variance += noise;
            }
        }
        Averages { ratios, variances }
    }
}

/// Squared differences beyond noise, weighted by the inverse of its variance, and these weights.
struct Excess {
    weighted: Vec<f32>,
    weights: Vec<f32>,
}

impl Excess {
    fn new(values: &[f32], centre: impl Fn(usize) -> f32, noise: &[f32]) -> Self {
        let weights: Vec<f32> = noise.iter().map(|noise| 1.0 / noise.max(MIN_VARIANCE)).collect();
        let weighted = |(i, value): (usize, &f32)| {
            let difference = value - centre(i);
            weights[i] * difference * difference - 1.0
        };
        Self { weighted: values.iter().enumerate().map(weighted).collect(), weights }
    }

    /// Returns the variance of values of one law.
    fn of_frame(&self) -> f32 {
        let (weighted, weights): (f32, f32) =
            (self.weighted.iter().sum(), self.weights.iter().sum());
        (weighted / weights.max(f32::MIN_POSITIVE)).max(0.0)
    }

    /// Returns the variance around every pixel.
    fn around(&self, size: Size, sigma: f32) -> Vec<f32> {
        let weighted = gaussian(&self.weighted, size, sigma);
        let weights = gaussian(&self.weights, size, sigma);
        let variance = |(excess, weight): (&f32, &f32)| excess / weight.max(f32::MIN_POSITIVE);
        weighted.iter().zip(&weights).map(variance).map(|variance| variance.max(0.0)).collect()
    }
}

/// Keeps of the differences from `centre` the part that their spread has of their variance, and of the noise
/// as much.
fn shrink(
    values: &mut [f32],
    noise: &mut [f32],
    centre: impl Fn(usize) -> f32,
    spread: impl Fn(usize) -> f32,
) {
    for (i, (value, noise)) in values.iter_mut().zip(noise).enumerate() {
        let kept = spread(i) / (spread(i) + *noise).max(MIN_VARIANCE);
        *value = centre(i) + kept * (*value - centre(i));
        *noise *= kept;
    }
}
