//! The bit order of packed frames, judged by the picture.
//!
//! Reversing the bits of every byte keeps neighbours within a byte next to each other. Only pairs across a
//! byte boundary change: the right order joins pixels 7 and 8, the wrong one pixels 0 and 15, which differ
//! more in any picture with structure.

use qudi_core::Size;

/// Standard errors beyond which the answer is certain.
pub const Z_SCORE_THRESHOLD: f64 = 5.0;

/// Rows of one unit: neighbouring rows see the same edges and are not independent.
const BLOCK_ROWS: usize = 16;

/// Pixels averaged on both sides of a boundary: fine ones for many photons, coarse ones for few.
const SCALES: [usize; 3] = [1, 2, 4];

/// Least number of units for an answer.
const MIN_UNITS: usize = 8;

/// Returns how well `sums` fit the order in which they were unpacked, in standard errors; negative if the
/// other order fits better. `sums` is the sum of frames packed along the width, row-major.
pub fn bit_order_z_score(sums: &[u32], size: Size) -> f64 {
    // The square root makes the noise of all counts alike.
    let roots: Vec<f32> = sums.iter().map(|&sum| (sum as f32).sqrt()).collect();
    SCALES
        .iter()
        .filter_map(|&scale| z_score_at(&roots, size, scale))
        .max_by(|a, b| a.abs().total_cmp(&b.abs()))
        .unwrap_or(0.0)
}

fn z_score_at(roots: &[f32], size: Size, scale: usize) -> Option<f64> {
    let Size { height, width } = size;
    let boundaries = (width / 8).saturating_sub(1);
    let bands = height / scale;
    let mean = |band: usize, column: usize| -> f32 {
        let rows = band * scale..(band + 1) * scale;
        rows.flat_map(|y| &roots[y * width + column..][..scale]).sum::<f32>()
    };
    let per_unit = (BLOCK_ROWS / scale).max(1);
    let mut units = Vec::new();
    for block in 0..bands / per_unit {
        for boundary in 1..=boundaries {
            let at = 8 * boundary;
            let gain: f32 = (block * per_unit..(block + 1) * per_unit)
                .map(|band| {
                    let joined = (mean(band, at - scale) - mean(band, at)).abs();
                    let apart = (mean(band, at - 8) - mean(band, at + 8 - scale)).abs();
                    apart - joined
                })
                .sum();
            units.push(f64::from(gain));
        }
    }
    standard_errors(&units)
}

/// Returns the mean of independent `units` in standard errors.
pub(crate) fn standard_errors(units: &[f64]) -> Option<f64> {
    if units.len() < MIN_UNITS {
        return None;
    }
    let n = units.len() as f64;
    let mean = units.iter().sum::<f64>() / n;
    let variance = units.iter().map(|u| (u - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (variance > 0.0).then(|| mean / (variance / n).sqrt())
}
