//! Filters of a group of similar blocks in the transform domain.

use super::block::{Block, Transform, haar, inverse_haar};
use wide::f32x8;

/// Shrinkage of coefficients.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Filter {
    /// Sets coefficients below this threshold to zero (eq. 4).
    Cut(f32),
    /// Multiplies coefficients by `b^2 / (b^2 + variance)`, where `b` is the basic estimate's coefficient
    /// (eq. 8).
    Wiener(f32),
}

impl Filter {
    /// Returns the 2-D transform of the pass (section IV-B).
    pub(crate) fn transform(self) -> Transform {
        match self {
            Self::Cut(_) => Transform::Bior,
            Self::Wiener(_) => Transform::Dct,
        }
    }

    /// Filters `noisy`, transformed blocks whose number is a power of two. `basic` holds the same blocks of
    /// the basic estimate. Returns the weight of the group: the inverse of its remaining noise variance (eqs.
    /// 10 and 11).
    pub(crate) fn apply(self, noisy: &mut [Block], basic: &mut [Block]) -> f32 {
        haar(noisy);
        // The group's mean is kept, however dark it is.
        let mean = noisy[0][0].to_array()[0];
        let weight = match self {
            Self::Cut(threshold) => cut(noisy, threshold),
            Self::Wiener(variance) => {
                haar(basic);
                shrink(noisy, basic, variance)
            }
        };
        let mut first = noisy[0][0].to_array();
        first[0] = mean;
        noisy[0][0] = f32x8::new(first);
        inverse_haar(noisy);
        weight
    }
}

fn cut(group: &mut [Block], threshold: f32) -> f32 {
    let limit = f32x8::splat(threshold);
    let mut kept = f32x8::splat(0.0);
    for row in group.iter_mut().flatten() {
        let large = row.abs().simd_gt(limit);
        kept += large & f32x8::splat(1.0);
        *row &= large;
    }
    1.0 / kept.reduce_add().max(1.0)
}

fn shrink(noisy: &mut [Block], basic: &[Block], variance: f32) -> f32 {
    let variance = f32x8::splat(variance);
    let mut energy = f32x8::splat(0.0);
    for (row, basic) in noisy.iter_mut().flatten().zip(basic.iter().flatten()) {
        let power = *basic * *basic;
        let factor = power / (power + variance);
        energy += factor * factor;
        *row *= factor;
    }
    1.0 / energy.reduce_add().max(f32::MIN_POSITIVE)
}
