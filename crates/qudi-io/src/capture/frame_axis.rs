//! Signs that an axis of an array was taken for the frames', and is not.
//!
//! Where rows of the scene are read as frames, the mean picture is a row's mean over time: it changes along
//! one of its axes, and hardly along the other, while the light changes from frame to frame.

use crate::description::Axes;
use qudi_core::Size;

/// Least number of frames, rows and columns for an answer.
const MIN_EXTENT: usize = 16;

/// Largest variance along the axis of time, in units of the variance along the other one.
const MAX_ALONG_TIME: f64 = 0.2;

/// Least standard deviation of the light of rows of a scene, in units of its mean.
const MIN_CHANGE: f64 = 0.05;

/// Least variance of sums of counts, in units of the one that their noise may have.
const MIN_EXCESS: f64 = 4.0;

/// Least variance of the difference between the profiles of two halves of the frames, in units of a
/// profile's: rows of a scene differ in more than their light.
const MIN_DIFFERENCE: f64 = 0.1;

/// Returns the axes that the array seems to have, if the ones that it was read with, frames first, seem
/// wrong. `halves` are the sums of the first and the second half of the measured frames, and `totals` has the
/// sum of the counts of each frame.
pub(super) fn likely_axes(halves: &[Vec<u32>; 2], totals: &[f64], size: Size) -> Option<Axes> {
    if totals.len() < MIN_EXTENT || size.height < MIN_EXTENT || size.width < MIN_EXTENT {
        return None;
    }
    let (mean, variance) = moments(totals.iter().copied());
    if variance.sqrt() < MIN_CHANGE * mean || variance < MIN_EXCESS * mean {
        return None;
    }
    let of_half = |half: usize, y: usize, x: usize| f64::from(halves[half][y * size.width + x]);
    let value = |y: usize, x: usize| of_half(0, y, x) + of_half(1, y, x);
    // Compares the variance within lines, less the noise that neighbours show, with the one between them.
    let even_within = |lines: usize, length: usize, value: &dyn Fn(usize, usize) -> f64| {
        let of_line = |line| {
            let (mean, variance) = moments((0..length).map(move |at| value(line, at)));
            let steps = (1..length).map(move |at| value(line, at) - value(line, at - 1));
            let noise = steps.map(|step| 0.5 * step * step).sum::<f64>() / (length - 1) as f64;
            (mean, variance - noise)
        };
        let (means, variances): (Vec<f64>, Vec<f64>) = (0..lines).map(of_line).unzip();
        let (within, _) = moments(variances.into_iter());
        let (mean, between) = moments(means.into_iter());
        let noise = MIN_EXCESS * mean / length as f64;
        between > noise.max((MIN_CHANGE * mean).powi(2)) && within < MAX_ALONG_TIME * between
    };
    // A light that changes leaves the shape of a profile as it is.
    let profiles_differ =
        |lines: usize, length: usize, value: &dyn Fn(usize, usize, usize) -> f64| {
            let profile = |half: usize| -> Vec<f64> {
                let of_line = |line| (0..length).map(|at| value(half, line, at)).sum::<f64>();
                let sums: Vec<f64> = (0..lines).map(of_line).collect();
                let mean = sums.iter().sum::<f64>() / lines as f64;
                sums.iter().map(|sum| sum / mean.max(f64::MIN_POSITIVE)).collect()
            };
            let (first, second) = (profile(0), profile(1));
            let (_, own) = moments(first.iter().zip(&second).map(|(a, b)| 0.5 * (a + b)));
            let (_, difference) = moments(first.iter().zip(&second).map(|(a, b)| a - b));
            difference > MIN_DIFFERENCE * own
        };
    let (height, width) = (size.height, size.width);
    if even_within(height, width, &value) && profiles_differ(height, width, &of_half) {
        return Some(Axes::Hwt);
    }
    let turned = |half: usize, x: usize, y: usize| of_half(half, y, x);
    let differ =
        even_within(width, height, &|x, y| value(y, x)) && profiles_differ(width, height, &turned);
    differ.then_some(Axes::Htw)
}

/// Returns mean and variance.
fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    (mean, values.map(|value| (value - mean).powi(2)).sum::<f64>() / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};

    /// Judges a noisy moving scene of 40 x 48 pixels and 60 frames whose array has the axes `axes`.
    fn seen(axes: Axes) -> Option<Axes> {
        let (height, width, frames) = (40, 48, 60);
        let mut rng = Streams::new(8).row(Domain::Photons, 0, 0);
        let size = match axes {
            Axes::Thw => Size { height, width },
            Axes::Hwt => Size { height: width, width: frames },
            _ => Size { height: frames, width },
        };
        let mut halves = [vec![0u32; size.pixels()], vec![0u32; size.pixels()]];
        let mut totals = vec![0.0; if axes == Axes::Thw { frames } else { height }];
        for t in 0..frames {
            for y in 0..height {
                for x in 0..width {
                    let (u, v) = (0.2 * x as f64 + 0.005 * t as f64, 0.13 * y as f64);
                    let light = 2.0 + (u + v).sin() + 0.6 * (2.0 * v).cos() + 0.3 * (3.0 * u).sin();
                    let count = (light + 2.0 * uniform(&mut rng)).floor() as u32;
                    let (frame, row, column) = match axes {
                        Axes::Thw => (t, y, x),
                        Axes::Hwt => (y, x, t),
                        _ => (y, t, x),
                    };
                    halves[2 * frame / totals.len()][row * size.width + column] += count;
                    totals[frame] += f64::from(count);
                }
            }
        }
        likely_axes(&halves, &totals, size)
    }

    #[test]
    fn frames_that_are_rows_of_the_scene_are_found() {
        assert_eq!(seen(Axes::Thw), None);
        assert_eq!(seen(Axes::Hwt), Some(Axes::Hwt));
        assert_eq!(seen(Axes::Htw), Some(Axes::Htw));
    }

    #[test]
    fn dark_captures_are_no_sign() {
        let size = Size { height: 64, width: 64 };
        let mut rng = Streams::new(9).row(Domain::Photons, 0, 0);
        let mut halves = [vec![0u32; size.pixels()], vec![0u32; size.pixels()]];
        let mut totals = vec![0.0; 40];
        for (t, total) in totals.iter_mut().enumerate() {
            for sum in &mut halves[t / 20] {
                let count = u32::from(uniform(&mut rng) < 0.001);
                *sum += count;
                *total += f64::from(count);
            }
        }
        assert_eq!(likely_axes(&halves, &totals, size), None);
    }

    #[test]
    fn flicker_and_horizons_alone_are_no_sign() {
        let size = Size { height: 32, width: 32 };
        let horizon: Vec<u32> = (0..size.pixels()).map(|i| 100 + (i / 32) as u32).collect();
        let field = |i: usize| ((i % 32 / 5 + i / 32 / 7) % 2) as u32;
        let chart: Vec<u32> =
            (0..size.pixels()).map(|i| 100 + 60 * field(i) + (i / 32) as u32).collect();
        let (steady, flickering) = (vec![1000.0; 40], [800.0, 1200.0].repeat(20));
        let twice = |sums: &[u32]| [sums.to_vec(), sums.iter().map(|sum| 2 * sum).collect()];
        let steep: Vec<u32> = (0..size.pixels()).map(|i| 100 + 5 * (i / 32) as u32).collect();
        assert_eq!(likely_axes(&twice(&horizon), &steady, size), None);
        assert_eq!(likely_axes(&twice(&chart), &flickering, size), None);
        assert_eq!(likely_axes(&twice(&steep), &flickering, size), None, "both at once");
    }
}
