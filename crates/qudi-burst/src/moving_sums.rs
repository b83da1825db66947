//! Moving sums of frames, and the window radius of least estimated risk.

use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::{CountLaw, CountMoments};
use qudi_core::windows::LONGEST_HALF;

/// Calls `f` for every frame, with the sum of the frames within `radius` of it and the number of these
/// frames. There are fewer at the ends of the window.
pub fn moving_sums(burst: BurstView<'_>, radius: usize, mut f: impl FnMut(&[u32], u32)) {
    let n = burst.frames.len();
    let mut sums = vec![0u32; burst.size.pixels()];
    let (mut from, mut to) = (0, 0);
    for frame in 0..n {
        let (low, high) = (frame.saturating_sub(radius), (frame + radius + 1).min(n));
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

/// Chooses the radius of moving means with Stein's unbiased risk estimate (SURE) on windows of the clip.
/// `noise_left` is the fraction of a mean's noise variance that remains after any later denoiser (1 without
/// one).
///
/// With `y` a frame's counts and `m` the mean of the `L` frames around it, `E (m - y)^2 + (2 / L - 1) Var y`
/// is the mean squared error of `m` (Stein 1981; Mallows 1973), of which `Var y / L` is noise. The sensor's
/// description gives `Var y`.
pub fn sure_window_radius(
    samples: &[BurstView<'_>],
    acquisition: &Acquisition,
    noise_left: f64,
) -> usize {
    let moments = CountMoments::new(&CountLaw::new(&acquisition.sensor, acquisition.gain));
    let risk = |burst: BurstView<'_>, variances: &[f64], radius: usize| -> f64 {
        let (mut total, mut frame) = (0.0, 0);
        moving_sums(burst, radius, |sums, n| {
            let n = f64::from(n);
            for (&sum, &own) in sums.iter().zip(&burst.frames[frame]) {
                total += (f64::from(sum) / n - f64::from(own)).powi(2);
            }
            total += ((1.0 + noise_left) / n - 1.0) * variances[frame];
            frame += 1;
        });
        total
    };
    let full = f64::from(acquisition.sensor.max_count());
    let mut risks = [0.0; LONGEST_HALF + 1];
    for burst in samples {
        // The longest mean gives the variance: short means of few bits lie at the ends, where the variance is
        // 0.
        let mut variances = Vec::with_capacity(burst.frames.len());
        moving_sums(*burst, LONGEST_HALF, |sums, n| {
            let n = f64::from(n);
            let of = |&sum: &u32| unbiased_variance(&moments, f64::from(sum) / n, n, full);
            variances.push(sums.iter().map(of).sum());
        });
        for (radius, total) in risks.iter_mut().enumerate() {
            *total += risk(*burst, &variances, radius);
        }
    }
    (0..risks.len()).min_by(|&a, &b| risks[a].total_cmp(&risks[b])).unwrap_or(0)
}

/// Estimates the variance of a count from the mean of `n` counts. The variance is a concave function of the
/// mean (`p (1 - p)` for binary frames), and the mean has a variance of `variance / n`. The bias is corrected
/// to second order.
fn unbiased_variance(moments: &CountMoments, mean: f64, n: f64, full: f64) -> f64 {
    let step = full / 16.0;
    let at = mean.clamp(step, full - step);
    let [low, middle, high] = [at - step, at, at + step].map(|m| moments.variance_at_mean(m));
    let bend = (low - 2.0 * middle + high) / (step * step);
    moments.variance_at_mean(mean) / (1.0 + 0.5 * bend / n).max(0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Light;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Frame, Size};

    /// Checks the choice on static scenes, including single binary frames, whose values never vary on their
    /// own.
    #[test]
    fn chooses_long_windows_for_static_scenes() {
        let size = Size { height: 48, width: 64 };
        let scene = Frame::from_fn(size, |x, y| 0.2 + 0.01 * ((x + 2 * y) % 50) as f32);
        let light = Light { ppp: 1.0, mean_level: 0.45 };
        for name in ["qudi-paper", "spad512s"] {
            let sensor = Sensor::load(name).unwrap();
            let mut camera = qudi_core::Camera::new(&sensor, size, light, 1).unwrap();
            let frames: Vec<Vec<u16>> =
                (0..11).map(|t| camera.expose(t, &[&scene]).unwrap()).collect();
            let acquisition = Acquisition::new(sensor, light.ppp, light.mean_level).unwrap();
            for noise_left in [1.0, 0.1] {
                let radius = sure_window_radius(
                    &[BurstView { size, frames: &frames }],
                    &acquisition,
                    noise_left,
                );
                // Beyond 7 frames hardly anything is gained.
                assert!(radius >= 3, "{name}, {noise_left} left: {radius}");
            }
        }
    }
}
