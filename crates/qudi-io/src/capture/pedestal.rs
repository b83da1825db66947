//! The pedestal of a dark capture, apart from its dark counts and its read noise.
//!
//! Read noise is symmetric and adds to the variance only. Dark electrons are Poisson distributed: each adds
//! the gain to the mean, its square to the variance and its cube to the third moment about the mean.

use super::Capture;
use qudi_core::Result;

/// Standard deviations of the counts by which they stay above zero if there is a pedestal.
const MIN_SIGMAS: f64 = 5.0;

/// Standard errors beyond which the third moment shows dark counts.
const SHOWN_ERRORS: f64 = 4.0;

/// Variance of rounding to whole numbers.
const ROUNDING: f64 = 1.0 / 12.0;

/// A pedestal, and the read noise about it.
#[derive(Clone, Copy, Debug)]
pub struct Pedestal {
    /// DN of no light.
    pub offset: f64,
    /// Dark electrons per frame that cannot be told from the pedestal; 0 where it was given.
    pub uncertain: f64,
    /// Read noise in e-.
    pub read_noise: f64,
}

/// Second and third moments of the ordinary pixels about their means, in DN.
struct Moments {
    second: f64,
    third: f64,
    /// Standard error of the third one.
    error: f64,
}

impl Pedestal {
    /// Takes the pedestal of `offset` DN, or finds one in dark frames whose pixels have `means`. `None` if
    /// nothing shows one.
    pub(super) fn find(
        capture: &mut Capture,
        gain: f64,
        offset: Option<f64>,
        means: &[f64],
    ) -> Result<Option<Self>> {
        let Some(moments) = moments(capture, means)? else { return Ok(None) };
        let Moments { second, third, error } = moments;
        let mut sorted = means.to_vec();
        sorted.sort_by(f64::total_cmp);
        let mean = sorted[sorted.len() / 2];
        let seen = if third > SHOWN_ERRORS * error { third / gain.powi(3) } else { 0.0 };
        let uncertain = SHOWN_ERRORS * error / gain.powi(3);
        let (offset, dark, uncertain) = match offset {
            Some(offset) => (offset, ((mean - offset) / gain).max(0.0), 0.0),
            None => (mean - gain * seen, seen, uncertain),
        };
        let is_shown = mean > MIN_SIGMAS * second.sqrt() && offset > 1.0 + gain * uncertain;
        if !is_shown {
            return Ok(None);
        }
        let read_noise = ((second - ROUNDING) / gain.powi(2) - dark).max(0.0).sqrt();
        Ok(Some(Self { offset, uncertain, read_noise }))
    }
}

/// Returns the pixels whose means lie in the middle, so that one dark rate describes them all.
pub(super) fn ordinary(means: &[f64]) -> Vec<usize> {
    let mut sorted = means.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    let middle = sorted[n * 3 / 10]..=sorted[n * 7 / 10];
    (0..n).filter(|&i| middle.contains(&means[i])).collect()
}

/// Measures the moments of sampled frames; `None` of fewer than three.
fn moments(capture: &mut Capture, means: &[f64]) -> Result<Option<Moments>> {
    let chosen = ordinary(means);
    let frames = capture.sample_frames();
    if frames.len() < 3 {
        return Ok(None);
    }
    let n = frames.len() as f64;
    let mut counts = vec![0u16; means.len()];
    // Moments about a fixed value, from which those about the mean follow.
    let mut powers = vec![[0.0f64; 3]; chosen.len()];
    for frame in frames {
        capture.read(frame, &mut counts)?;
        for (powers, &i) in powers.iter_mut().zip(&chosen) {
            let value = f64::from(counts[i]) - means[i];
            let all = [value, value * value, value * value * value];
            powers.iter_mut().zip(all).for_each(|(sum, power)| *sum += power);
        }
    }
    let (mut second, mut third) = (0.0, 0.0);
    for [one, two, three] in powers {
        let [one, two, three] = [one / n, two / n, three / n];
        second += (two - one * one) * n / (n - 1.0);
        third += (three - 3.0 * one * two + 2.0 * one.powi(3)) * n * n / (n - 1.0) / (n - 2.0);
    }
    let pixels = chosen.len() as f64;
    let (second, third) = (second / pixels, third / pixels);
    let error = (6.0 * second.powi(3) / (n * pixels)).sqrt();
    Ok(Some(Moments { second, third, error }))
}
