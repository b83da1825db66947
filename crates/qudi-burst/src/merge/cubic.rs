//! Sampling of patches between pixels by cubic convolution (Keys, "Cubic convolution interpolation for
//! digital image processing", IEEE TASSP 29(6), 1981). It keeps fine texture that bilinear interpolation
//! loses.

use crate::patch::{Patch, SIDE, inside};
use multiversion::multiversion;
use qudi_core::Frame;

/// Returns the weights of the samples at -1, 0, 1 and 2 for a position `part` between 0 and 1 (Keys 1981, eq.
/// 15).
fn taps(part: f32) -> [f32; 4] {
    let near = |s: f32| (1.5 * s - 2.5) * s * s + 1.0;
    let far = |s: f32| ((2.5 - 0.5 * s) * s - 4.0) * s + 2.0;
    [far(1.0 + part), near(part), near(1.0 - part), far(2.0 - part)]
}

/// Returns the factor by which the taps reduce the variance of white noise along an axis.
pub(crate) fn noise_factor(part: f32) -> f32 {
    taps(part).iter().map(|tap| tap * tap).sum()
}

/// Samples the patch whose corner is at `corner`; the image's borders are repeated.
#[multiversion(targets("x86_64+avx2"))]
fn cubic(image: &Frame, corner: [f32; 2]) -> Patch {
    let (width, height) = (image.size.width as isize, image.size.height as isize);
    let [x, y] = corner.map(|c| c.floor() as isize - 1);
    let [across, down] = corner.map(|c| taps(c - c.floor()));
    // Plain loops over whole rows vectorize.
    let mut rows = [[0.0f32; SIDE]; SIDE + 3];
    let within = x >= 0 && x + (SIDE as isize) + 3 <= width;
    for (r, row) in (y..).zip(&mut rows) {
        let source = image.row(r.clamp(0, height - 1) as usize);
        if within {
            *row = along(across, &source[x as usize..x as usize + SIDE + 3]);
        } else {
            let around: [f32; SIDE + 3] =
                std::array::from_fn(|c| source[(x + c as isize).clamp(0, width - 1) as usize]);
            *row = along(across, &around);
        }
    }
    let mut patch = [[0.0f32; SIDE]; SIDE];
    for (r, row) in patch.iter_mut().enumerate() {
        for c in 0..SIDE {
            row[c] = weighted(down, [rows[r][c], rows[r + 1][c], rows[r + 2][c], rows[r + 3][c]]);
        }
    }
    patch
}

/// Samples the patch whose corner is at `at`. Pixels outside the image are taken from `own` at `corner`.
pub(crate) fn cubic_within(image: &Frame, at: [f32; 2], own: &Frame, corner: [usize; 2]) -> Patch {
    let mut patch = cubic(image, at);
    let (columns, rows) = (inside(at[0], image.size.width), inside(at[1], image.size.height));
    if columns.len() * rows.len() < SIDE * SIDE {
        for (y, row) in patch.iter_mut().enumerate() {
            let instead = &own.row(corner[1] + y)[corner[0]..];
            for (x, (value, instead)) in row.iter_mut().zip(instead).enumerate() {
                if !columns.contains(&x) || !rows.contains(&y) {
                    *value = *instead;
                }
            }
        }
    }
    patch
}

/// Interpolates a row between the pixels of `source`.
#[inline(always)]
fn along(taps: [f32; 4], source: &[f32]) -> [f32; SIDE] {
    let (a, b) = (&source[..SIDE], &source[1..=SIDE]);
    let (c, d) = (&source[2..2 + SIDE], &source[3..3 + SIDE]);
    // A plain loop: closures are not compiled for the caller's vector unit.
    let mut row = [0.0; SIDE];
    for x in 0..SIDE {
        row[x] = weighted(taps, [a[x], b[x], c[x], d[x]]);
    }
    row
}

#[inline(always)]
fn weighted(taps: [f32; 4], values: [f32; 4]) -> f32 {
    taps[0] * values[0] + taps[1] * values[1] + taps[2] * values[2] + taps[3] * values[3]
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    /// Checks that cubic convolution reproduces parabolas (Keys 1981, section III).
    #[test]
    fn reproduces_parabolas() {
        let parabola = |x: f32, y: f32| 0.02 * x * x - 0.03 * y * y + 0.01 * x * y + x - 0.5 * y;
        let size = Size { height: 30, width: 34 };
        let image = Frame::from_fn(size, |x, y| parabola(x as f32, y as f32));
        let patch = cubic(&image, [5.3, 7.8]);
        for (r, row) in patch.iter().enumerate() {
            for (c, value) in row.iter().enumerate() {
                let expected = parabola(5.3 + c as f32, 7.8 + r as f32);
                assert!((value - expected).abs() < 1e-3, "{value}, not {expected}");
            }
        }
    }

    #[test]
    fn returns_whole_pixels_and_repeats_borders() {
        let size = Size { height: SIDE, width: SIDE };
        let image = Frame::from_fn(size, |x, y| (x * 31 + y * 17) as f32);
        assert_eq!(cubic(&image, [0.0, 0.0])[3][9], image.row(3)[9]);
        assert_eq!(cubic(&image, [40.0, -40.0])[0][0], image.row(0)[SIDE - 1]);
        assert!((noise_factor(0.0) - 1.0).abs() < 1e-6 && noise_factor(0.5) < 0.7);
    }
}
