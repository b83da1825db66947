//! Moving sums of frames, and how many frames they should span.

use super::{BurstView, Context};
use crate::sensor::{CountLaw, CountMoments};

/// Most frames on either side: a window of 11.
pub const LONGEST_HALF: usize = 5;

/// Sums of the frames within `half` of each frame, and how many those are; the window's ends have
/// fewer.
pub fn moving_sums(burst: BurstView<'_>, half: usize, mut f: impl FnMut(&[u32], u32)) {
    let n = burst.frames.len();
    let mut sums = vec![0u32; burst.size.pixels()];
    let (mut from, mut to) = (0, 0);
    for frame in 0..n {
        let (low, high) = (frame.saturating_sub(half), (frame + half + 1).min(n));
        while to < high {
            for (sum, &count) in sums.iter_mut().zip(&burst.frames[to]) {
                *sum += u32::from(count);
            }
            to += 1;
        }
        while from < low {
            for (sum, &count) in sums.iter_mut().zip(&burst.frames[from]) {
                *sum -= u32::from(count);
            }
            from += 1;
        }
        f(&sums, (high - low) as u32);
    }
}

/// Frames on either side whose mean has the least risk on windows of the clip, if `noise_left` of
/// the variance of a mean is left by what follows (1 if nothing does).
///
/// With `y` a frame's counts and `m` the mean of the `L` frames around it, `E (m - y)^2 + (2 / L - 1) Var y`
/// is the mean squared error of `m` (Stein 1981; Mallows 1973), of which `Var y / L` is noise; the
/// sensor says what `Var y` is.
pub fn half_of_least_risk(samples: &[BurstView<'_>], context: &Context, noise_left: f64) -> usize {
    let moments = CountMoments::new(&CountLaw::new(&context.sensor, context.gain));
    let risk = |half: usize| -> f64 {
        let mut total = 0.0;
        for burst in samples {
            let mut frame = 0;
            moving_sums(*burst, half, |sums, n| {
                let n = f64::from(n);
                for (&sum, &own) in sums.iter().zip(&burst.frames[frame]) {
                    let mean = f64::from(sum) / n;
                    let difference = mean - f64::from(own);
                    // The longest mean would know the variance best; it hardly matters.
                    let variance = moments.variance_at_mean(mean);
                    total += difference * difference + ((1.0 + noise_left) / n - 1.0) * variance;
                }
                frame += 1;
            });
        }
        total
    };
    let risks: Vec<f64> = (0..=LONGEST_HALF).map(risk).collect();
    (0..risks.len()).min_by(|&a, &b| risks[a].total_cmp(&risks[b])).unwrap_or(0)
}
