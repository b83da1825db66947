//! Discrete Fourier transform of 16 x 16 patches, sixteen columns at a time.

use crate::patch::{Patch, SIDE};
use multiversion::multiversion;
use std::f32::consts::PI;
use std::sync::LazyLock;

/// Coefficients of a patch, transposed; all users treat both axes alike.
#[derive(Clone, Debug)]
pub(crate) struct Spectrum {
    pub(crate) re: Patch,
    pub(crate) im: Patch,
}

/// Cosine and sine of `-2 pi k / 16`.
static TWIDDLES: LazyLock<[(f32, f32); SIDE / 2]> = LazyLock::new(|| {
    std::array::from_fn(|k| {
        let (sin, cos) = (-2.0 * PI * k as f32 / SIDE as f32).sin_cos();
        (cos, sin)
    })
});

impl Spectrum {
    pub(crate) const ZERO: Self = Self { re: [[0.0; SIDE]; SIDE], im: [[0.0; SIDE]; SIDE] };
}

/// Computes the unnormalised transform: white noise of variance v has variance `256 v` per coefficient.
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn forward(patch: &Patch, spectrum: &mut Spectrum) {
    spectrum.re = *patch;
    spectrum.im = [[0.0; SIDE]; SIDE];
    columns(spectrum);
    transpose(spectrum);
    columns(spectrum);
}

/// Computes the real part of the inverse. Inlined, to be compiled for the vector unit of its caller.
#[inline(always)]
pub(crate) fn inverse(mut spectrum: Spectrum) -> Patch {
    // The inverse is the transform with real and imaginary parts exchanged before and after.
    std::mem::swap(&mut spectrum.re, &mut spectrum.im);
    columns(&mut spectrum);
    transpose(&mut spectrum);
    columns(&mut spectrum);
    let scale = 1.0 / (SIDE * SIDE) as f32;
    for value in spectrum.im.iter_mut().flatten() {
        *value *= scale;
    }
    spectrum.im
}

/// Applies the radix-2 transform (Cooley and Tukey 1965) down all columns.
#[inline(always)]
fn columns(Spectrum { re, im }: &mut Spectrum) {
    for i in 0..SIDE {
        let j = ((i as u8).reverse_bits() >> 4) as usize;
        if i < j {
            re.swap(i, j);
            im.swap(i, j);
        }
    }
    let mut half = 1;
    while half < SIDE {
        for start in (0..SIDE).step_by(2 * half) {
            for k in 0..half {
                let (cos, sin) = TWIDDLES[k * (SIDE / 2) / half];
                let (a, b) = (start + k, start + k + half);
                for x in 0..SIDE {
                    let turned_re = re[b][x] * cos - im[b][x] * sin;
                    let turned_im = re[b][x] * sin + im[b][x] * cos;
                    (re[a][x], re[b][x]) = (re[a][x] + turned_re, re[a][x] - turned_re);
                    (im[a][x], im[b][x]) = (im[a][x] + turned_im, im[a][x] - turned_im);
                }
            }
        }
        half *= 2;
    }
}

#[inline(always)]
fn transpose(Spectrum { re, im }: &mut Spectrum) {
    for part in [re, im] {
        let old = *part;
        for y in 0..SIDE {
            for x in 0..SIDE {
                part[y][x] = old[x][y];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dft_matches_its_definition_and_inverts() {
        let patch: Patch =
            std::array::from_fn(|y| std::array::from_fn(|x| ((x * 5 + y * y * 3) % 17) as f32));
        let mut spectrum = Spectrum::ZERO;
        forward(&patch, &mut spectrum);
        for (u, v) in [(0, 0), (1, 0), (3, 7), (15, 9)] {
            let (mut re, mut im) = (0.0, 0.0);
            for (y, row) in patch.iter().enumerate() {
                for (x, value) in row.iter().enumerate() {
                    let (sin, cos) = (-2.0 * PI * (u * x + v * y) as f32 / 16.0).sin_cos();
                    re += value * cos;
                    im += value * sin;
                }
            }
            // The spectrum is transposed: the column index runs along u.
            assert!((spectrum.re[u][v] - re).abs() < 0.02, "{u} {v}");
            assert!((spectrum.im[u][v] - im).abs() < 0.02, "{u} {v}");
        }
        for (a, b) in inverse(spectrum).iter().flatten().zip(patch.iter().flatten()) {
            assert!((a - b).abs() < 1e-4);
        }
    }
}
