//! 8 x 8 blocks in registers, and the orthonormal or unit-norm transforms of BM3D on them.
//!
//! A block is eight rows of eight lanes. A 2-D transform works down the columns, transposes, and works down
//! them again, so the coefficients are stored transposed. All coefficients are treated alike, and the inverse
//! transposes them back.

use wide::f32x8;

/// Side of a block in pixels (Dabov et al. 2007, table I).
pub(crate) const BLOCK: usize = 8;

/// Rows of a block.
pub(crate) type Block = [f32x8; BLOCK];

/// A 2-D transform and its inverse.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Transform {
    /// Biorthogonal wavelet 1.5 over three levels, periodic. Each row has unit norm, so that every
    /// coefficient has the same noise.
    Bior,
    /// Discrete cosine transform.
    Dct,
}

impl Transform {
    pub(crate) fn forward(self, block: &mut Block) {
        let step = match self {
            Self::Bior => bior,
            Self::Dct => dct,
        };
        step(block);
        *block = f32x8::transpose(*block);
        step(block);
    }

    pub(crate) fn inverse(self, block: &mut Block) {
        let step = match self {
            Self::Bior => inverse_bior,
            Self::Dct => inverse_dct,
        };
        step(block);
        *block = f32x8::transpose(*block);
        step(block);
    }
}

/// Loads the block of `image` (rows of `width`) whose corner is at offset `at`.
#[inline]
pub(crate) fn load(image: &[f32], width: usize, at: usize) -> Block {
    std::array::from_fn(|r| {
        let mut row = [0.0; BLOCK];
        row.copy_from_slice(&image[at + r * width..at + r * width + BLOCK]);
        f32x8::new(row)
    })
}

/// Adds `row` to eight samples.
#[inline]
pub(crate) fn add_row(samples: &mut [f32], row: f32x8) {
    let mut sum = [0.0; BLOCK];
    sum.copy_from_slice(samples);
    samples.copy_from_slice(&(f32x8::new(sum) + row).to_array());
}

/// Applies the orthonormal 1-D Haar transform across `group`, whose length is a power of two, in place.
#[inline]
pub(crate) fn haar(group: &mut [Block]) {
    let n = group.len();
    let mut step = 1;
    while step < n {
        for i in (0..n).step_by(2 * step) {
            butterfly(group, i, i + step);
        }
        step *= 2;
    }
}

/// Applies the inverse of [`haar`] in place.
#[inline]
pub(crate) fn inverse_haar(group: &mut [Block]) {
    let n = group.len();
    let mut step = n / 2;
    while step > 0 {
        for i in (0..n).step_by(2 * step) {
            butterfly(group, i, i + step);
        }
        step /= 2;
    }
}

/// Replaces two blocks by their sum and difference over the square root of two; its own inverse.
#[inline]
fn butterfly(group: &mut [Block], i: usize, j: usize) {
    const ROOT: f32 = std::f32::consts::FRAC_1_SQRT_2;
    let (low, high) = group.split_at_mut(j);
    for (a, b) in low[i].iter_mut().zip(&mut high[0]) {
        let (sum, difference) = (*a + *b, *a - *b);
        *a = sum * ROOT;
        *b = difference * ROOT;
    }
}

/// Lifting coefficient of the wavelet: the outer taps of its low-pass filter, 11/64 of the neighbouring
/// details. On a period of 8 the outermost pair (3/128) cancels itself, as all outer taps do at the coarser
/// levels, which are Haar's.
const LIFT: f32 = 11.0 / 64.0;

/// Norms that the lifting leaves: of the two details of level 2, and of the detail of level 3.
const NORM_2: f64 = 1.0 + 2.0 * 0.171_875 * 0.171_875;
const NORM_3: f64 = 1.0 + 4.0 * 0.171_875 * 0.171_875;

fn norms() -> [f32; 2] {
    [NORM_2.sqrt() as f32, NORM_3.sqrt() as f32]
}

#[inline]
fn bior(x: &mut Block) {
    let root = f32x8::splat(std::f32::consts::FRAC_1_SQRT_2);
    let lift = f32x8::splat(LIFT);
    let [norm_2, norm_3] = norms();
    let detail: [f32x8; 4] = std::array::from_fn(|i| (x[2 * i + 1] - x[2 * i]) * root);
    let low: [f32x8; 4] = std::array::from_fn(|i| {
        (x[2 * i] + x[2 * i + 1]) * root + (detail[(i + 3) % 4] - detail[(i + 1) % 4]) * lift
    });
    let half = f32x8::splat(0.5);
    let pair = [low[0] + low[1], low[2] + low[3]];
    let scale_2 = root * f32x8::splat(1.0 / norm_2);
    *x = [
        (pair[0] + pair[1]) * half,
        (pair[0] - pair[1]) * half * f32x8::splat(1.0 / norm_3),
        (low[0] - low[1]) * scale_2,
        (low[2] - low[3]) * scale_2,
        detail[0],
        detail[1],
        detail[2],
        detail[3],
    ];
}

#[inline]
fn inverse_bior(x: &mut Block) {
    let root = f32x8::splat(std::f32::consts::FRAC_1_SQRT_2);
    let half = f32x8::splat(0.5);
    let lift = f32x8::splat(LIFT);
    let [norm_2, norm_3] = norms();
    let difference = x[1] * f32x8::splat(norm_3);
    let pair = [(x[0] + difference) * half, (x[0] - difference) * half];
    let inner = [x[2], x[3]].map(|d| d * root * f32x8::splat(norm_2));
    let low = [pair[0] + inner[0], pair[0] - inner[0], pair[1] + inner[1], pair[1] - inner[1]];
    let detail = [x[4], x[5], x[6], x[7]];
    for i in 0..4 {
        let sum = low[i] - (detail[(i + 3) % 4] - detail[(i + 1) % 4]) * lift;
        x[2 * i] = (sum - detail[i]) * root;
        x[2 * i + 1] = (sum + detail[i]) * root;
    }
}

/// `cos(k pi / 16) / 2`.
const C: [f32; 8] = [
    0.5,
    0.490_392_64,
    0.461_939_77,
    0.415_734_8,
    0.353_553_4,
    0.277_785_12,
    0.191_341_71,
    0.097_545_16,
];

#[inline]
fn dct(x: &mut Block) {
    let c = C.map(f32x8::splat);
    let s: [f32x8; 4] = std::array::from_fn(|i| x[i] + x[7 - i]);
    let d: [f32x8; 4] = std::array::from_fn(|i| x[i] - x[7 - i]);
    let (outer, inner) = (s[0] + s[3], s[1] + s[2]);
    let (e, f) = (s[0] - s[3], s[1] - s[2]);
    *x = [
        (outer + inner) * c[4],
        d[0] * c[1] + d[1] * c[3] + d[2] * c[5] + d[3] * c[7],
        e * c[2] + f * c[6],
        d[0] * c[3] - d[1] * c[7] - d[2] * c[1] - d[3] * c[5],
        (outer - inner) * c[4],
        d[0] * c[5] - d[1] * c[1] + d[2] * c[7] + d[3] * c[3],
        e * c[6] - f * c[2],
        d[0] * c[7] - d[1] * c[5] + d[2] * c[3] - d[3] * c[1],
    ];
}

#[inline]
fn inverse_dct(x: &mut Block) {
    let c = C.map(f32x8::splat);
    let (outer, inner) = ((x[0] + x[4]) * c[4], (x[0] - x[4]) * c[4]);
    let e = x[2] * c[2] + x[6] * c[6];
    let f = x[2] * c[6] - x[6] * c[2];
    let s = [outer + e, inner + f, inner - f, outer - e];
    let d = [
        x[1] * c[1] + x[3] * c[3] + x[5] * c[5] + x[7] * c[7],
        x[1] * c[3] - x[3] * c[7] - x[5] * c[1] - x[7] * c[5],
        x[1] * c[5] - x[3] * c[1] + x[5] * c[7] + x[7] * c[3],
        x[1] * c[7] - x[3] * c[5] + x[5] * c[3] - x[7] * c[1],
    ];
    for i in 0..4 {
        x[i] = s[i] + d[i];
        x[7 - i] = s[i] - d[i];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some_block() -> Block {
        std::array::from_fn(|r| {
            f32x8::new(std::array::from_fn(|c| ((r * 37 + c * 101 + r * c * 7) % 64) as f32))
        })
    }

    fn largest_difference(a: &Block, b: &Block) -> f32 {
        let of = |(a, b): (&f32x8, &f32x8)| (*a - *b).abs().to_array();
        a.iter().zip(b).flat_map(of).fold(0.0, f32::max)
    }

    #[test]
    fn unbiased_inverse_inverts_the_transform() {
        for transform in [Transform::Bior, Transform::Dct] {
            let mut block = some_block();
            transform.forward(&mut block);
            transform.inverse(&mut block);
            assert!(largest_difference(&block, &some_block()) < 1e-4, "{transform:?}");
        }
        let mut group: Vec<Block> =
            (0..16).map(|i| some_block().map(|row| row * i as f32)).collect();
        let before = group.clone();
        haar(&mut group);
        assert!(largest_difference(&group[0], &before[15].map(|row| row * 2.0)) < 1e-2);
        inverse_haar(&mut group);
        for (a, b) in group.iter().zip(&before) {
            assert!(largest_difference(a, b) < 1e-3);
        }
    }

    /// Checks that rows of the 1-D matrices have norm 1, so that coefficients of white noise keep its
    /// variance.
    #[test]
    fn rows_have_unit_norm_and_cosines_are_cosines() {
        for (step, name) in [(bior as fn(&mut Block), "bior"), (dct, "dct")] {
            let mut columns: Block = std::array::from_fn(|r| {
                f32x8::new(std::array::from_fn(|c| f32::from(u8::from(r == c))))
            });
            step(&mut columns);
            for (k, row) in columns.iter().enumerate() {
                let norm: f32 = row.to_array().iter().map(|v| v * v).sum();
                assert!((norm - 1.0).abs() < 1e-6, "{name} row {k}: {norm}");
                if name == "dct" {
                    for (n, v) in row.to_array().iter().enumerate() {
                        let scale = if k == 0 { 0.125f64.sqrt() } else { 0.5 };
                        let angle = std::f64::consts::PI * k as f64 * (n as f64 + 0.5) / 8.0;
                        assert!((f64::from(*v) - scale * angle.cos()).abs() < 1e-6);
                    }
                }
            }
        }
    }

    #[test]
    fn constant_images_have_zero_distance() {
        let mut flat: Block = [f32x8::splat(3.0); 8];
        Transform::Bior.forward(&mut flat);
        assert!((flat[0].to_array()[0] - 24.0).abs() < 1e-5);
        let rest: f32 = flat.iter().map(|row| row.abs().reduce_add()).sum::<f32>() - 24.0;
        assert!(rest.abs() < 1e-4, "{rest}");
    }
}
