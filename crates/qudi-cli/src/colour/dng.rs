//! The names of DNG for the colours of a capture (Adobe, Digital Negative Specification 1.7).

use super::Rendering;
use qudi_core::colour::{Colour, ColourFilter, FilterChoice};
use qudi_core::restorer::Acquisition;
use serde_json::{Value, json};

/// Linear sRGB of XYZ under D65 (IEC 61966-2-1).
const SRGB_OF_XYZ: [[f64; 3]; 3] = [
    [3.240_625_5, -1.537_208, -0.498_628_6],
    [-0.968_930_7, 1.875_756_1, 0.041_517_5],
    [0.055_710_1, -0.204_021_1, 1.056_995_9],
];

/// Returns the tags of a DNG that describe the colours of a capture.
pub(crate) fn dng_tags(
    choice: &FilterChoice,
    filter: &ColourFilter,
    acquisition: &Acquisition,
    rendering: &Rendering,
) -> Value {
    let sensor = &acquisition.sensor;
    let dark = sensor.dark_per_frame().unwrap_or(0.0);
    let mut tags = json!({
        "BlackLevel": dark * acquisition.gain,
        "WhiteLevel": sensor.max_count(),
        "AsShotNeutral": rendering.gains.0.map(|gain| 1.0 / gain),
    });
    match choice {
        FilterChoice::Tile(mosaic) => {
            let side = mosaic.side();
            let size = filter.size();
            let code = |i: usize| {
                let (y, x) = ((i / side).min(size.height - 1), (i % side).min(size.width - 1));
                match filter.colours()[y * size.width + x] {
                    Colour::White => 6,
                    other => other as u8,
                }
            };
            tags["CFARepeatPatternDim"] = json!([side, side]);
            tags["CFAPattern"] = json!((0..side * side).map(code).collect::<Vec<_>>());
        }
        FilterChoice::Picture(path) => tags["CFAPattern"] = json!(path),
    }
    if let Some(matrix) = rendering.colour.matrix.and_then(inverse) {
        let neutral = rendering.gains.0.map(|gain| 1.0 / gain);
        let balanced = product(&matrix, &SRGB_OF_XYZ);
        let camera: [[f64; 3]; 3] = std::array::from_fn(|k| balanced[k].map(|v| v * neutral[k]));
        tags["ColorMatrix1"] = json!(camera);
    }
    tags
}

fn product(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|y| std::array::from_fn(|x| (0..3).map(|k| a[y][k] * b[k][x]).sum()))
}

/// Inverts a matrix, if it can be inverted.
fn inverse(m: [[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    // The entry of the adjugate: rows and columns follow each other in a circle, so that signs are right.
    let cofactor = |y: usize, x: usize| {
        let (a, b, c, d) = ((y + 1) % 3, (y + 2) % 3, (x + 1) % 3, (x + 2) % 3);
        m[a][c] * m[b][d] - m[a][d] * m[b][c]
    };
    let determinant: f64 = (0..3).map(|x| m[0][x] * cofactor(0, x)).sum();
    (determinant.abs() > 1e-12)
        .then(|| std::array::from_fn(|y| std::array::from_fn(|x| cofactor(x, y) / determinant)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_times_matrix_is_identity() {
        let matrix = [[1.8, -0.6, -0.2], [-0.3, 1.5, -0.2], [0.0, -0.5, 1.5]];
        let identity = product(&inverse(matrix).unwrap(), &matrix);
        for (y, row) in identity.iter().enumerate() {
            for (x, value) in row.iter().enumerate() {
                assert!((value - f64::from(u8::from(x == y))).abs() < 1e-12, "{identity:?}");
            }
        }
        assert!(inverse([[1.0; 3]; 3]).is_none());
    }
}
