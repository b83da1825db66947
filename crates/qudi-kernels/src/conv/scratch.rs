//! How values lie in scratch memory: as they are, or rounded to bfloat16.

use super::source::copy_row;
use crate::matrix_units::MatrixUnits;
use pulp::{Arch, Simd, WithSimd};

/// What one place in scratch memory, 32 bits, holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// One value of one plane.
    Single,
    /// The same, rounded to bfloat16.
    Rounded,
    /// Values of two neighbouring planes in bfloat16, the first in the lower half.
    Pairs,
    /// The same for tiles, which take planes by groups of so many pairs.
    Tiles(usize),
}

/// Most pairs of planes of a tile.
const GROUP: usize = 16;

impl Format {
    /// What a convolution over `planes` input planes uses.
    pub(super) fn new(bf16: bool, planes: usize) -> Self {
        match (bf16, MatrixUnits::current()) {
            (false, _) => Self::Single,
            (true, MatrixUnits::F32) => Self::Rounded,
            (true, MatrixUnits::Avx512Bf16) => Self::Pairs,
            (true, MatrixUnits::Amx) => {
                let pairs = planes.div_ceil(2);
                Self::Tiles(pairs.div_ceil(pairs.div_ceil(GROUP)))
            }
        }
    }

    /// Scratch planes for `planes` input planes; those past the last one are zero.
    pub(super) fn scratch_planes(self, planes: usize) -> usize {
        match self {
            Self::Single | Self::Rounded => planes,
            Self::Pairs => planes.div_ceil(2),
            Self::Tiles(group) => planes.div_ceil(2).next_multiple_of(group),
        }
    }

    /// Scratch planes that only go together.
    pub(super) fn group(self) -> usize {
        if let Self::Tiles(group) = self { group } else { 1 }
    }

    /// What stands in the place of scratch plane `number` for `value(plane)`.
    pub(super) fn place(self, number: usize, value: impl Fn(usize) -> f32) -> f32 {
        match self {
            Self::Single => value(number),
            Self::Rounded => round(value(number)),
            Self::Pairs | Self::Tiles(_) => pair(value(2 * number), value(2 * number + 1)),
        }
    }
}

/// The upper half of a value's bits, rounded to the nearest, ties to even.
#[inline(always)]
pub(super) fn upper(x: f32) -> u32 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1));
    // The carry must not run over what says that it is not a number.
    if x.is_nan() { 0x7fc0 } else { rounded >> 16 }
}

/// The nearest bfloat16.
#[inline(always)]
pub(super) fn round(x: f32) -> f32 {
    f32::from_bits(upper(x) << 16)
}

/// The bits of two values in bfloat16.
#[inline(always)]
pub(super) fn pair(first: f32, second: f32) -> f32 {
    f32::from_bits(upper(second) << 16 | upper(first))
}

/// A row of a plane, and its mask.
pub(super) type Row<'a> = (&'a [f32], Option<&'a [f32]>);

/// Copies rows of input planes, `left` and `step` as in [`copy_row`], to a row of scratch. `spare` is as long
/// as the row.
pub(super) fn fill_row(
    format: Format,
    rows: [Option<Row<'_>>; 2],
    left: isize,
    step: usize,
    to: &mut [f32],
    spare: &mut [f32],
) {
    let copy = |row: Option<Row<'_>>, to: &mut [f32]| match row {
        Some((from, mask)) => copy_row(from, mask, left, step, to),
        None => to.fill(0.0),
    };
    copy(rows[0], to);
    match format {
        Format::Single => {}
        Format::Rounded => round_all(to),
        Format::Pairs | Format::Tiles(_) => {
            let second = &mut spare[..to.len()];
            copy(rows[1], second);
            Arch::new().dispatch(PairRows { to, second });
        }
    }
}

/// Rounds values in place.
pub(super) fn round_all(values: &mut [f32]) {
    for value in values {
        *value = round(*value);
    }
}

/// Joins two rows into one of pairs. A struct, since closures are not compiled for the vector unit.
struct PairRows<'a> {
    to: &'a mut [f32],
    second: &'a [f32],
}

impl WithSimd for PairRows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (to, &second) in self.to.iter_mut().zip(self.second) {
            *to = pair(*to, second);
        }
    }
}

/// Rounds values into half the memory.
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
