//! Innermost loops: a block of output channels times a few vectors of neighbouring pixels, kept in registers
//! during the loop over all taps.
//!
//! A tap is an offset into scratch memory, so the same loops serve every kernel size, stride and direction.
// Plain indices over arrays of known length: the compiler unrolls them into registers.
#![allow(unsafe_code, clippy::needless_range_loop)]

use super::scratch::Format;
use super::tiles;
use pulp::{Arch, Simd, WithSimd};
use std::hint::black_box;

/// Block sizes in channels and vectors. 12 accumulators fit 16 registers (AVX2), 24 fit 32 (AVX-512, NEON).
/// The best come first: more channels need fewer loads.
pub(super) const KINDS: [(usize, usize); 8] =
    [(12, 2), (10, 2), (8, 3), (8, 2), (6, 2), (12, 1), (4, 3), (4, 2)];

/// Returns true if registers hold the sums of a block, its pixels and a weight, with one to spare: without,
/// compilers move sums from register to register.
fn fits(&(channels, vectors): &(usize, usize)) -> bool {
    channels * vectors + vectors + 1 < machine().1
}

/// Chooses the block size that takes the fewest instructions for results of `outputs` channels and `columns`
/// pixels.
pub(super) fn block(outputs: usize, columns: usize) -> (usize, usize) {
    let lanes = machine().0;
    let cost = |&(channels, vectors): &(usize, usize)| {
        let blocks = outputs.div_ceil(channels) * columns.div_ceil(vectors * lanes);
        // Loads take about as long as four products.
        blocks * (channels * vectors + 4)
    };
    // Of equal costs, the first is chosen.
    KINDS.into_iter().filter(fits).min_by_key(cost).unwrap_or(KINDS[7])
}

/// Work on blocks of results, compiled for each of their sizes.
pub(super) trait BlockWork<S: Simd> {
    /// Does the work in blocks of `M` channels by `V` vectors of pixels.
    ///
    /// # Safety
    /// As the type says.
    unsafe fn blocks<const M: usize, const V: usize>(self, simd: S);
}

/// Does `work` in blocks of a size of [`KINDS`].
///
/// # Safety
/// As [`BlockWork::blocks`].
#[inline(always)]
pub(super) unsafe fn in_blocks<S: Simd>(simd: S, block: (usize, usize), work: impl BlockWork<S>) {
    // SAFETY: the caller's promise.
    unsafe {
        match block {
            b if b == KINDS[0] => work.blocks::<{ KINDS[0].0 }, { KINDS[0].1 }>(simd),
            b if b == KINDS[1] => work.blocks::<{ KINDS[1].0 }, { KINDS[1].1 }>(simd),
            b if b == KINDS[2] => work.blocks::<{ KINDS[2].0 }, { KINDS[2].1 }>(simd),
            b if b == KINDS[3] => work.blocks::<{ KINDS[3].0 }, { KINDS[3].1 }>(simd),
            b if b == KINDS[4] => work.blocks::<{ KINDS[4].0 }, { KINDS[4].1 }>(simd),
            b if b == KINDS[5] => work.blocks::<{ KINDS[5].0 }, { KINDS[5].1 }>(simd),
            b if b == KINDS[6] => work.blocks::<{ KINDS[6].0 }, { KINDS[6].1 }>(simd),
            _ => work.blocks::<{ KINDS[7].0 }, { KINDS[7].1 }>(simd),
        }
    }
}

/// Returns the longest run of pixels of a block on this machine.
pub(super) fn longest_run(format: Format) -> usize {
    match format {
        Format::Tiles(_) => tiles::PIXELS,
        _ => KINDS.into_iter().filter(fits).map(|kind| kind.1).max().unwrap_or(1) * lanes(),
    }
}

/// Returns the number of values in a vector on this machine.
pub(super) fn lanes() -> usize {
    machine().0
}

/// Returns the number of values in a vector on this machine, and its number of registers.
fn machine() -> (usize, usize) {
    struct Machine;
    impl WithSimd for Machine {
        type Output = (usize, usize);
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> (usize, usize) {
            (S::F32_LANES, S::REGISTER_COUNT)
        }
    }
    Arch::new().dispatch(Machine)
}

/// Multiplication of the 32-bit entries of scratch memory and weights.
pub(super) trait Products<S: Simd> {
    /// Computes `a * b + sum`.
    ///
    /// # Safety
    /// The machine must have the instructions.
    unsafe fn multiply_add(simd: S, a: S::f32s, b: S::f32s, sum: S::f32s) -> S::f32s;
}

/// Multiplication of entries that hold one f32 each.
#[derive(Debug)]
pub(super) struct Single;

impl<S: Simd> Products<S> for Single {
    #[inline(always)]
    unsafe fn multiply_add(simd: S, a: S::f32s, b: S::f32s, sum: S::f32s) -> S::f32s {
        simd.mul_add_e_f32s(a, b, sum)
    }
}

/// Computes `sums[m][v] += sum over k of weights[k * M + m] * x[offsets[k] + v * lanes ..]`.
///
/// # Safety
/// `x` must be valid for reads of `V * S::F32_LANES` values from every one of the `offsets`, and `weights`
/// for `offsets.len() * M` values; the machine must have the instructions of `P`.
#[inline(always)]
pub(super) unsafe fn accumulate<S: Simd, P: Products<S>, const M: usize, const V: usize>(
    simd: S,
    x: *const f32,
    offsets: &[u32],
    weights: *const f32,
    sums: &mut [[S::f32s; V]; M],
) {
    let mut acc = *sums;
    let mut weight = weights;
    for &offset in offsets {
        // SAFETY: the caller's promise; vectors are read unaligned.
        unsafe {
            let at = x.add(offset as usize);
            let mut pixels = [simd.splat_f32s(0.0); V];
            for v in 0..V {
                pixels[v] = at.add(v * S::F32_LANES).cast::<S::f32s>().read_unaligned();
            }
            for m in 0..M {
                let factor = simd.splat_f32s(*weight.add(m));
                for v in 0..V {
                    acc[m][v] = P::multiply_add(simd, factor, pixels[v], acc[m][v]);
                }
            }
            weight = weight.add(M);
        }
    }
    *sums = acc;
}

/// Sums `dy[m][p] * x[offsets[k] + p]` over rows and their pixels `p < length`, lane by lane. Rows of `dy`
/// are `length` values apart, rows of `x` are `step` values apart.
///
/// # Safety
/// A value has `T`'s size. Each `dy` must be valid for `rows * length` values and every row of `x` for
/// `length` values from each of the `offsets`; they fill whole vectors. The machine must have the
/// instructions of `P`.
#[inline(always)]
pub(super) unsafe fn correlate<S: Simd, P: Products<S>, T, const M: usize, const K: usize>(
    simd: S,
    dy: [*const T; M],
    x: *const T,
    offsets: [usize; K],
    [rows, length, step]: [usize; 3],
) -> [[S::f32s; K]; M] {
    // A zero that the compiler does not know: it would store a known one to memory first, with a call.
    let zero = simd.splat_f32s(black_box(0.0));
    let mut sums = [[zero; K]; M];
    for row in 0..rows {
        let mut p = 0;
        while p < length {
            // SAFETY: the caller's promise; vectors are read unaligned.
            unsafe {
                let mut taps = [simd.splat_f32s(0.0); K];
                for k in 0..K {
                    let from = x.add(offsets[k] + row * step + p);
                    taps[k] = from.cast::<S::f32s>().read_unaligned();
                }
                for m in 0..M {
                    let from = dy[m].add(row * length + p);
                    let gradient = from.cast::<S::f32s>().read_unaligned();
                    for k in 0..K {
                        sums[m][k] = P::multiply_add(simd, gradient, taps[k], sums[m][k]);
                    }
                }
            }
            p += size_of::<S::f32s>() / size_of::<T>();
        }
    }
    sums
}

/// Writes the first `count` values of a run.
///
/// # Safety
/// `to` must be valid for writes of `count` values, `count <= V * S::F32_LANES`.
#[inline(always)]
pub(super) unsafe fn store<S: Simd, const V: usize>(run: [S::f32s; V], to: *mut f32, count: usize) {
    if count == V * S::F32_LANES {
        for (v, vector) in run.into_iter().enumerate() {
            // SAFETY: the whole run is within `count`.
            unsafe { to.add(v * S::F32_LANES).cast::<S::f32s>().write_unaligned(vector) };
        }
    } else {
        let values: &[f32] = pulp::bytemuck::cast_slice(&run);
        // SAFETY: the caller's promise; `run` is no part of the output.
        unsafe { std::ptr::copy_nonoverlapping(values.as_ptr(), to, count) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whatever the sizes, registers hold a block, and little work goes into results that there are not, but
    /// for few channels and narrow images.
    #[test]
    fn blocks_fit_registers_and_results() {
        for outputs in 1..200 {
            for columns in 1..200 {
                let kind = block(outputs, columns);
                assert!(fits(&kind), "{kind:?} for {outputs} channels, {columns} columns");
                let (channels, vectors) = (kind.0, kind.1 * lanes());
                let done = outputs.next_multiple_of(channels) * columns.next_multiple_of(vectors);
                let needed = outputs.next_multiple_of(4) * columns.next_multiple_of(2 * lanes());
                assert!(
                    4 * done <= 5 * needed,
                    "{kind:?} for {outputs} channels, {columns} columns"
                );
            }
        }
    }
}
