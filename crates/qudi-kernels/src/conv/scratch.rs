//! Formats of scratch memory: f32, or rounded to bfloat16.

use crate::matrix_units::MatrixUnits;
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// Content of a 32-bit entry of scratch memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// One value of one plane.
    Single,
    /// One value, rounded to bfloat16.
    Rounded,
    /// Values of two neighbouring planes in bfloat16, the first in the lower half.
    Pairs,
    /// Pairs as above, for matrix units that take planes in groups of this many pairs.
    Tiles(usize),
}

/// Maximum number of pairs of planes in a tile.
const MAX_GROUP: usize = 16;

impl Format {
    /// Chooses the format of a convolution over `planes` input planes.
    pub(super) fn new(bf16: bool, planes: usize) -> Self {
        match (bf16, MatrixUnits::current()) {
            (false, _) => Self::Single,
            (true, MatrixUnits::F32) => Self::Rounded,
            (true, MatrixUnits::Avx512Bf16) => Self::Pairs,
            (true, MatrixUnits::Amx) => {
                let pairs = planes.div_ceil(2);
                Self::Tiles(pairs.div_ceil(pairs.div_ceil(MAX_GROUP)))
            }
        }
    }

    /// Returns the number of scratch planes for `planes` input planes; the last ones may be zero.
    pub(super) fn scratch_planes(self, planes: usize) -> usize {
        match self {
            Self::Single | Self::Rounded => planes,
            Self::Pairs => planes.div_ceil(2),
            Self::Tiles(group) => planes.div_ceil(2).next_multiple_of(group),
        }
    }

    /// Returns the number of scratch planes that must be multiplied together.
    pub(super) fn group(self) -> usize {
        if let Self::Tiles(group) = self { group } else { 1 }
    }

    /// Returns the entry of scratch plane `number`, where `value(plane)` is the value of an input plane.
    pub(super) fn place(self, number: usize, value: impl Fn(usize) -> f32) -> f32 {
        match self {
            Self::Single => value(number),
            Self::Rounded => round(value(number)),
            Self::Pairs | Self::Tiles(_) => pair(value(2 * number), value(2 * number + 1)),
        }
    }
}

/// Returns the upper half of a value's bits, rounded to the nearest, ties to even.
#[inline(always)]
pub(crate) fn upper(x: f32) -> u32 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1));
    // The carry must not turn NaN into another number.
    if x.is_nan() { 0x7fc0 } else { rounded >> 16 }
}

/// Rounds to the nearest bfloat16.
#[inline(always)]
pub(super) fn round(x: f32) -> f32 {
    f32::from_bits(upper(x) << 16)
}

/// Packs two values in bfloat16 into 32 bits.
#[inline(always)]
pub(super) fn pair(first: f32, second: f32) -> f32 {
    f32::from_bits(upper(second) << 16 | upper(first))
}

/// A row of a plane, and its mask.
pub(super) type Row<'a> = (&'a [f32], Option<&'a [f32]>);

/// Copies rows of input planes to a row of scratch memory: `to[i]` is the entry of the values at
/// `left + i * step`, zero outside and where the mask is not positive. Inlined, to be compiled for the vector
/// unit of its caller.
#[inline(always)]
pub(super) fn fill_row(
    format: Format,
    rows: [Option<Row<'_>>; 2],
    left: isize,
    step: usize,
    to: &mut [f32],
) {
    let Some((values, _)) = rows[0].or(rows[1]) else {
        to.fill(0.0);
        return;
    };
    let inside = inside(values.len(), left, step, to.len());
    to[..inside.start].fill(0.0);
    to[inside.end..].fill(0.0);
    if inside.is_empty() {
        return;
    }
    let offset = (left + (inside.start * step) as isize) as usize;
    let to = &mut to[inside];
    match format {
        Format::Single => {
            if let Some(row) = rows[0] {
                copy(row, offset, step, to);
            }
        }
        Format::Rounded => {
            if let Some(row) = rows[0] {
                copy(row, offset, step, to);
            }
            round_all(to);
        }
        Format::Pairs | Format::Tiles(_) => join(rows, offset, step, to),
    }
}

/// Returns the positions in a row of `length` scratch values whose sources lie in a row of `available`
/// values.
#[inline(always)]
fn inside(available: usize, left: isize, step: usize, length: usize) -> Range<usize> {
    let step = step as isize;
    let place = |at: isize| ((at + step - 1).div_euclid(step).max(0) as usize).min(length);
    let start = place(-left);
    start..place(available as isize - left).max(start)
}

/// Copies a row, starting at `offset`.
#[inline(always)]
pub(super) fn copy((from, mask): Row<'_>, offset: usize, step: usize, to: &mut [f32]) {
    let from = &from[offset..];
    match mask {
        None if step == 1 => to.copy_from_slice(&from[..to.len()]),
        None => {
            for (to, &from) in to.iter_mut().zip(from.iter().step_by(step)) {
                *to = from;
            }
        }
        // Only gradients are masked; they are read one by one.
        Some(mask) => {
            debug_assert_eq!(step, 1);
            for ((to, &from), &mask) in to.iter_mut().zip(from).zip(&mask[offset..]) {
                *to = if mask > 0.0 { from } else { 0.0 };
            }
        }
    }
}

/// Joins two rows to one row of pairs; a missing row is zero.
#[inline(always)]
fn join(rows: [Option<Row<'_>>; 2], offset: usize, step: usize, to: &mut [f32]) {
    match rows {
        [Some((a, None)), Some((b, None))] if step == 1 => {
            for ((to, &a), &b) in to.iter_mut().zip(&a[offset..]).zip(&b[offset..]) {
                *to = pair(a, b);
            }
        }
        [Some((a, Some(mask_a))), Some((b, Some(mask_b)))] => {
            debug_assert_eq!(step, 1);
            let masks = mask_a[offset..].iter().zip(&mask_b[offset..]);
            let values = a[offset..].iter().zip(&b[offset..]);
            for ((to, (&a, &b)), (&mask_a, &mask_b)) in to.iter_mut().zip(values).zip(masks) {
                let (a, b) =
                    (if mask_a > 0.0 { a } else { 0.0 }, if mask_b > 0.0 { b } else { 0.0 });
                *to = pair(a, b);
            }
        }
        [Some((a, None)), Some((b, None))] => {
            debug_assert_eq!(step, 2);
            pairs_of_every_second(&a[offset..], &b[offset..], to);
        }
        [first, second] => {
            let row = first.or(second).expect("the caller has one");
            copy(row, offset, step, to);
            let shift = if first.is_some() { 0 } else { 16 };
            for to in to {
                *to = f32::from_bits(upper(*to) << shift);
            }
        }
    }
}

/// Joins every second value of two rows. The loop reads pairs of values, which vectorizes; strides would not.
#[inline(always)]
fn pairs_of_every_second(a: &[f32], b: &[f32], to: &mut [f32]) {
    let Some((last, to)) = to.split_last_mut() else { return };
    let end = 2 * to.len();
    for ((to, a), b) in to.iter_mut().zip(a.chunks_exact(2)).zip(b.chunks_exact(2)) {
        *to = pair(a[0], b[0]);
    }
    *last = pair(a[end], b[end]);
}

/// Rounds values in place.
#[inline(always)]
pub(super) fn round_all(values: &mut [f32]) {
    for value in values {
        *value = round(*value);
    }
}

/// Conversion of values to bfloat16 in half the memory.
pub(super) struct Narrow<'a> {
    pub(super) from: &'a [f32],
    pub(super) to: &'a mut [u16],
}

impl WithSimd for Narrow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (to, &from) in self.to.iter_mut().zip(self.from) {
            *to = upper(from) as u16;
        }
    }
}
