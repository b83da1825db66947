//! Gradients of a convolution's weights and bias.
#![allow(unsafe_code)]

use super::micro;
use super::micro::{Products, Single};
#[cfg(target_arch = "x86_64")]
use super::pairs::{PairWork, Pairs, with_pairs};
use super::pass::{Pass, Tiling};
use super::run::SCRATCH;
use super::scratch::{Format, Narrow, round_all};
use super::source::Source;
use super::weight_tiles;
use super::winograd;
use crate::matrix_units::MatrixUnits;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Taps per block.
const TAPS: usize = 3;

/// Number of partial sums: enough for many threads, and independent of their number.
pub(super) const PARTS: usize = 16;

/// Gradients of weights, `[outputs, planes, taps]`, and of the bias.
#[derive(Debug)]
pub(crate) struct WeightGradient {
    pub(crate) weight: Vec<f32>,
    pub(crate) bias: Vec<f32>,
}

/// Number of pixels in a vector of bfloat16.
const HALVES: usize = 32;

/// Sums `gradient` (on the pass's grid) times the values that the taps read from `source`, over all images
/// and results. The sizes are planes of `source`, images, and channels of `gradient`.
pub(super) fn weight_gradient(
    source: Source<'_>,
    [planes, images, outputs]: [usize; 3],
    pass: &Pass,
    gradient: Source<'_>,
    bf16: bool,
) -> WeightGradient {
    if winograd::serves(pass, Format::new(bf16, planes), planes, outputs) {
        return winograd::weight_gradient(source, [planes, images, outputs], gradient);
    }
    if bf16 && MatrixUnits::current() == MatrixUnits::Amx {
        return weight_tiles::weight_gradient(source, [planes, images, outputs], pass, gradient);
    }
    let halves = bf16 && MatrixUnits::current() == MatrixUnits::Avx512Bf16;
    let run = if halves { HALVES } else { micro::longest_run(Format::Single) };
    let tiling = pass.tiling(Format::Single, planes, run);
    let offsets = tiling.offsets(pass, tiling.planes);
    let arch = Arch::new();
    let tasks = images * tiling.count();
    let parts = PARTS.min(tasks);
    let partial = |part: usize| {
        let mut sums = WeightGradient {
            weight: vec![0.0; outputs * planes * pass.taps.len()],
            bias: vec![0.0; outputs],
        };
        for task in part * tasks / parts..(part + 1) * tasks / parts {
            let (image, number) = (task / tiling.count(), task % tiling.count());
            let (at, size) = tiling.tile(number, pass.grid);
            SCRATCH.with_borrow_mut(|scratch| {
                let lanes = if halves { HALVES } else { micro::lanes() };
                let length = tiling.columns.next_multiple_of(lanes);
                let area = tiling.scratch();
                let needed = area + outputs * tiling.rows * length;
                // Rounded values are stored after their f32 originals.
                let all = if halves { needed + needed.div_ceil(2) } else { needed };
                if scratch.len() < all {
                    scratch.resize(all, 0.0);
                }
                let (values, narrow) = scratch[..all].split_at_mut(needed);
                let (taps, dy) = values.split_at_mut(area);
                let dy = &mut dy[..outputs * size[0] * length];
                let narrow: &mut [u16] = pulp::bytemuck::cast_slice_mut(narrow);
                let (narrow_taps, narrow_dy) = narrow.split_at_mut(if halves { area } else { 0 });
                gradient.copy_tile(image, at, size, length, dy);
                for (channel, sum) in dy.chunks_exact(size[0] * length).zip(&mut sums.bias) {
                    *sum += channel.iter().sum::<f32>();
                }
                if halves {
                    arch.dispatch(Narrow { from: dy, to: narrow_dy });
                } else if bf16 {
                    round_all(dy);
                }
                let mut first = 0;
                while first < planes {
                    let end = (first + tiling.planes).min(planes);
                    source.fill(image, first..end, pass, &tiling, at, taps);
                    if halves {
                        arch.dispatch(Narrow { from: taps, to: narrow_taps });
                    } else if bf16 {
                        round_all(taps);
                    }
                    let tile = Tile {
                        taps,
                        dy,
                        narrow_taps,
                        narrow_dy,
                        offsets: &offsets[..(end - first) * pass.taps.len()],
                        first: first * pass.taps.len(),
                        all: planes * pass.taps.len(),
                        rows: size[0],
                        length,
                        outputs,
                        pass,
                        tiling: &tiling,
                        weight: &mut sums.weight,
                    };
                    #[cfg(target_arch = "x86_64")]
                    if halves {
                        with_pairs(tile);
                    } else {
                        arch.dispatch(tile);
                    }
                    #[cfg(not(target_arch = "x86_64"))]
                    arch.dispatch(tile);
                    first = end;
                }
            });
        }
        sums
    };
    WeightGradient::sum((0..parts).into_par_iter().map(partial).collect())
}

impl WeightGradient {
    /// Adds partial sums.
    pub(super) fn sum(mut parts: Vec<Self>) -> Self {
        let mut sums = parts.swap_remove(0);
        for part in parts {
            add(&mut sums.weight, &part.weight);
            add(&mut sums.bias, &part.bias);
        }
        sums
    }
}

fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

/// Work on one filled tile.
struct Tile<'a> {
    taps: &'a [f32],
    /// Gradients `[outputs][rows][length]`, zero past the tile's columns.
    dy: &'a [f32],
    /// Taps in bfloat16, where products use it.
    narrow_taps: &'a [u16],
    /// Gradients in bfloat16, where products use it.
    narrow_dy: &'a [u16],
    offsets: &'a [u32],
    /// Index of the first offset among `all` taps of one output.
    first: usize,
    all: usize,
    rows: usize,
    length: usize,
    outputs: usize,
    pass: &'a Pass,
    tiling: &'a Tiling,
    weight: &'a mut [f32],
}

impl WithSimd for Tile<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let values = (self.taps.as_ptr(), self.dy.as_ptr());
        // SAFETY: `Single` needs no instructions beyond `S`. The block has as many output channels as
        // registers hold.
        unsafe {
            if S::REGISTER_COUNT >= 32 {
                self.blocks::<S, Single, f32, 8, TAPS>(simd, values);
            } else {
                self.blocks::<S, Single, f32, 4, TAPS>(simd, values);
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
impl PairWork for Tile<'_> {
    #[inline(always)]
    unsafe fn work(self, simd: pulp::x86::V4) {
        let values = (self.narrow_taps.as_ptr(), self.narrow_dy.as_ptr());
        // SAFETY: the caller's promise.
        unsafe { self.blocks::<_, Pairs, u16, 8, TAPS>(simd, values) }
    }
}

impl Tile<'_> {
    /// Computes the sums of all blocks of `M` channels by `K` taps.
    ///
    /// # Safety
    /// The machine must have the instructions of `P`; `taps` and `dy` must belong to this tile.
    #[inline(always)]
    unsafe fn blocks<S: Simd, P: Products<S>, T, const M: usize, const K: usize>(
        self,
        simd: S,
        (taps, dy): (*const T, *const T),
    ) {
        let channel = self.rows * self.length;
        for m in (0..self.outputs).step_by(M) {
            for k in (0..self.offsets.len()).step_by(K) {
                // The last block repeats its last channel and tap, and drops the repeats.
                let outputs: [usize; M] =
                    std::array::from_fn(|i| (m + i).min(self.outputs - 1) * channel);
                let offsets: [usize; K] = std::array::from_fn(|j| {
                    self.offsets[(k + j).min(self.offsets.len() - 1)] as usize
                });
                let sizes = [self.rows, self.length, self.pass.stride * self.tiling.row];
                // SAFETY: rows of `dy` are `length` long, whole vectors; as many values lie in scratch memory
                // after every tap of a row (`Pass::tiling`).
                let sums = unsafe {
                    let dy = outputs.map(|start| dy.add(start));
                    micro::correlate::<S, P, T, M, K>(simd, dy, taps, offsets, sizes)
                };
                for (i, sums) in sums.iter().enumerate().take(self.outputs - m) {
                    for (j, &sum) in sums.iter().enumerate().take(self.offsets.len() - k) {
                        let place = (m + i) * self.all + self.first + k + j;
                        self.weight[place] += simd.reduce_sum_f32s(sum);
                    }
                }
            }
        }
    }
}
