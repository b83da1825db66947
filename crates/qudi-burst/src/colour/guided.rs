//! Averages over the counts around a pixel: all of them, or those whose luma and chroma are like its own.

use super::{Chroma, Evidence};
use multiversion::multiversion;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Standard deviation of the logarithm of luma over which pixels count as alike.
const LUMA_SIGMA: f32 = 0.3;

/// Standard deviation of the ratios to luma over which pixels count as alike, for ratios whose luma weights
/// add up to 1.
const CHROMA_SIGMA: f32 = 0.2;

/// Radius of averages in standard deviations.
const RADIUS: f32 = 2.0;

/// Blurs with a Gaussian; nothing lies outside.
pub(super) fn gaussian(values: &[f32], size: Size, sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as usize;
    let tap = |d: usize| (-0.5 * (d as f32 / sigma).powi(2)).exp();
    let taps: Vec<f32> = (0..=2 * radius).map(|i| tap(i.abs_diff(radius))).collect();
    let total: f32 = taps.iter().sum();
    let Size { height, width } = size;
    let mut rows = vec![0.0f32; values.len()];
    rows.par_chunks_mut(width).zip(values.par_chunks(width)).for_each(|(out, row)| {
        for (i, tap) in taps.iter().enumerate() {
            // Pixel x takes x + i - radius.
            let (first, from) = (radius.saturating_sub(i), i.saturating_sub(radius));
            for (out, value) in out.iter_mut().skip(first).zip(row.iter().skip(from)) {
                *out += tap / total * value;
            }
        }
    });
    let mut out = vec![0.0f32; values.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (i, tap) in taps.iter().enumerate() {
            let Some(from) = (y + i).checked_sub(radius).filter(|&row| row < height) else {
                continue;
            };
            for (out, value) in out.iter_mut().zip(&rows[from * width..(from + 1) * width]) {
                *out += tap / total * value;
            }
        }
    });
    out
}

/// The luma that guides averages.
pub(super) struct Guide {
    /// Logarithm of luma, in units of [`LUMA_SIGMA`].
    logarithm: Vec<f32>,
    pub(super) luma: Vec<f32>,
}

impl Guide {
    /// Takes the luma that guides; it is at least `least`.
    pub(super) fn new(luma: &Frame, least: f32) -> Self {
        let luma: Vec<f32> = luma.data.iter().map(|luma| luma.max(least)).collect();
        // Differences of very dark pixels are noise.
        let floor = 20.0 * least;
        let logarithm = luma.iter().map(|luma| (luma + floor).ln() / LUMA_SIGMA).collect();
        Self { logarithm, luma }
    }
}

/// Ratios of sensor colours to luma, averaged over counts around every pixel.
pub(super) struct Averages {
    pub(super) ratios: [Vec<f32>; 3],
    /// Variances of the ratios by the noise of the counts.
    pub(super) variances: [Vec<f32>; 3],
}

/// Share of the weight in a Gaussian average that the square of its weights has.
const SQUARED: f32 = 0.5;

/// Variance of a ratio of which no count tells.
const UNKNOWN: f32 = 10.0;

/// Sums of one row.
struct RowSums {
    counts: [Vec<f32>; 3],
    slopes: [Vec<f32>; 3],
    variances: [Vec<f32>; 3],
    alike: Vec<f32>,
}

/// Returns the ratios of sensor colours to luma, averaged with a Gaussian of standard deviation `sigma` over
/// pixels whose luma is alike, and whose chroma is alike in `previous`; `otherwise` where no count tells.
pub(super) fn guided(
    guide: &Guide,
    evidence: &Evidence,
    size: Size,
    sigma: f32,
    (otherwise, previous): (&[Vec<f32>; 3], Option<&Chroma>),
) -> Averages {
    let Size { height, width } = size;
    let radius = (RADIUS * sigma).ceil() as isize;
    let zeros = || std::array::from_fn(|_| vec![0.0f32; width]);
    let rows: Vec<[Vec<[f32; 2]>; 3]> = (0..height)
        .into_par_iter()
        .map(|y| {
            let mut sums = RowSums {
                counts: zeros(),
                slopes: zeros(),
                variances: zeros(),
                alike: vec![0.0; width],
            };
            let here = y * width;
            for dy in -radius..=radius {
                let Some(row) = y.checked_add_signed(dy).filter(|&row| row < height) else {
                    continue;
                };
                for dx in -radius..=radius {
                    let near = (dx * dx + dy * dy) as f32 / (2.0 * sigma * sigma);
                    if near > 0.5 * RADIUS * RADIUS || dx.unsigned_abs() >= width {
                        continue;
                    }
                    let (first, from) = ((-dx).max(0) as usize, dx.max(0) as usize);
                    let n = width - dx.unsigned_abs();
                    let (a, b) = (here + first, row * width + from);
                    let alike = &mut sums.alike[..n];
                    let (own, other) = (a..a + n, b..b + n);
                    let logarithm = &guide.logarithm;
                    differences(alike, &logarithm[own.clone()], &logarithm[other.clone()]);
                    if let Some(previous) = previous {
                        for ratios in &previous.ratios {
                            add_squares(alike, &ratios[own.clone()], &ratios[other.clone()]);
                        }
                    }
                    likeness(alike, (-near).exp());
                    for k in 0..3 {
                        let Evidence { counts, slopes, variances } = evidence;
                        for (sums, values) in [
                            (&mut sums.counts[k], &counts[k]),
                            (&mut sums.slopes[k], &slopes[k]),
                            (&mut sums.variances[k], &variances[k]),
                        ] {
                            add_weighted(&mut sums[first..], alike, &values[other.clone()]);
                        }
                    }
                }
            }
            std::array::from_fn(|k| {
                let ratio = |x: usize| {
                    let slope = sums.slopes[k][x];
                    if slope < f32::MIN_POSITIVE {
                        return [otherwise[k][here + x], UNKNOWN];
                    }
                    let noise = SQUARED * sums.variances[k][x] / (slope * slope);
                    [(sums.counts[k][x] / slope).max(0.0), noise.min(UNKNOWN)]
                };
                (0..width).map(ratio).collect()
            })
        })
        .collect();
    let column =
        |k: usize, of: usize| rows.iter().flat_map(move |row| row[k].iter().map(move |v| v[of]));
    Averages {
        ratios: std::array::from_fn(|k| column(k, 0).collect()),
        variances: std::array::from_fn(|k| column(k, 1).collect()),
    }
}

/// Sets squared differences of logarithms of luma, halved.
#[multiversion(targets("x86_64+avx2"))]
fn differences(out: &mut [f32], own: &[f32], other: &[f32]) {
    for ((out, own), other) in out.iter_mut().zip(own).zip(other) {
        *out = 0.5 * (own - other) * (own - other);
    }
}

/// Adds squared differences of ratios, halved, in units of their standard deviation.
#[multiversion(targets("x86_64+avx2"))]
fn add_squares(out: &mut [f32], own: &[f32], other: &[f32]) {
    const SCALE: f32 = 0.5 / (CHROMA_SIGMA * CHROMA_SIGMA);
    for ((out, own), other) in out.iter_mut().zip(own).zip(other) {
        *out += SCALE * (own - other) * (own - other);
    }
}

/// Turns halved squares into weights: `near` times nearly their exponential.
#[multiversion(targets("x86_64+avx2"))]
fn likeness(values: &mut [f32], near: f32) {
    for value in values {
        let root = 1.0 / (1.0 + 0.125 * *value);
        let square = root * root;
        let fourth = square * square;
        *value = near * fourth * fourth;
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn add_weighted(sums: &mut [f32], weights: &[f32], values: &[f32]) {
    for ((sum, weight), value) in sums.iter_mut().zip(weights).zip(values) {
        *sum += weight * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_keep_sums_inside_and_spread_evenly() {
        let size = Size { height: 21, width: 25 };
        let mut values = vec![0.0; size.pixels()];
        values[10 * 25 + 12] = 1.0;
        let blurred = gaussian(&values, size, 1.5);
        assert!((blurred.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        let at = |y: usize, x: usize| blurred[y * 25 + x];
        assert!((at(10, 14) - at(12, 12)).abs() < 1e-7 && (at(9, 12) - at(11, 12)).abs() < 1e-7);
        let expected = (-0.5f32 * (2.0f32 / 1.5).powi(2)).exp();
        assert!((at(10, 14) / at(10, 12) - expected).abs() < 1e-4);
    }

    #[test]
    fn weights_are_nearly_exponential() {
        let mut values = [0.0, 0.5, 2.0];
        likeness(&mut values, 1.0);
        for (value, expected) in values.iter().zip([1.0, 0.607, 0.135]) {
            assert!((value - expected).abs() < 0.04, "{value} {expected}");
        }
    }
}
