//! Averages over the counts around a pixel: all of them, or those whose luma and chroma are like its own.

use super::{Chroma, CountResponse, MergedColours};
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

/// Counts with the luma that guides their averages.
pub(super) struct Guide<'a> {
    merged: &'a MergedColours,
    /// Logarithm of luma, in units of [`LUMA_SIGMA`].
    logarithm: Vec<f32>,
    /// Luma times the weights of red, green and blue counts.
    luma: [Vec<f32>; 3],
    own: Vec<f32>,
}

impl<'a> Guide<'a> {
    /// Takes the luma that guides; it is at least `least`.
    pub(super) fn new(merged: &'a MergedColours, luma: &Frame, least: f32) -> Self {
        let own: Vec<f32> = luma.data.iter().map(|luma| luma.max(least)).collect();
        // Differences of very dark pixels are noise.
        let floor = 20.0 * least;
        let logarithm = own.iter().map(|luma| (luma + floor).ln() / LUMA_SIGMA).collect();
        let weighted = |k: usize| merged.weights[k].iter().zip(&own).map(|(w, luma)| w * luma);
        let luma = std::array::from_fn(|k| weighted(k).collect());
        Self { merged, logarithm, luma, own }
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
    weights: [Vec<f32>; 3],
    luma: [Vec<f32>; 3],
    alike: Vec<f32>,
}

/// Returns the ratios of sensor colours to luma, averaged with a Gaussian of standard deviation `sigma` over
/// pixels whose luma is alike, and whose chroma is alike in `previous`.
pub(super) fn guided(
    guide: &Guide<'_>,
    response: &CountResponse,
    sigma: f32,
    previous: Option<&Chroma>,
) -> Averages {
    let MergedColours { size, counts, weights } = guide.merged;
    let Size { height, width } = *size;
    let radius = (RADIUS * sigma).ceil() as isize;
    let zeros = || std::array::from_fn(|_| vec![0.0f32; width]);
    let rows: Vec<[Vec<[f32; 2]>; 3]> = (0..height)
        .into_par_iter()
        .map(|y| {
            let mut sums = RowSums {
                counts: zeros(),
                weights: zeros(),
                luma: zeros(),
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
                        add_weighted(
                            &mut sums.counts[k][first..],
                            alike,
                            &counts[k][other.clone()],
                        );
                        add_weighted(
                            &mut sums.weights[k][first..],
                            alike,
                            &weights[k][other.clone()],
                        );
                        add_weighted(
                            &mut sums.luma[k][first..],
                            alike,
                            &guide.luma[k][other.clone()],
                        );
                    }
                }
            }
            std::array::from_fn(|k| {
                let ratio = |x: usize| {
                    let weight = sums.weights[k][x];
                    if weight < 1e-6 {
                        let ratio = previous.map_or(1.0, |chroma| chroma.ratios[k][here + x]);
                        return [ratio, UNKNOWN];
                    }
                    let light = response.image(sums.counts[k][x] / weight).max(0.0);
                    let luma = (sums.luma[k][x] / weight).max(1e-9 + 1e-3 * guide.own[here + x]);
                    let there = response.at(light, response.dark);
                    let noise = there.variance * SQUARED / (there.slope * there.slope * weight);
                    [light / luma, (noise / (luma * luma)).min(UNKNOWN)]
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
