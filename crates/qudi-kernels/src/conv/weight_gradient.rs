//! The gradients of a convolution's weights and bias.
#![allow(unsafe_code)]

use super::micro;
use super::pass::{Pass, Tiling};
use super::run::SCRATCH;
use super::source::Source;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Taps of a block.
const TAPS: usize = 3;

/// Partial sums: enough for many threads, and the same for any number of them.
const PARTS: usize = 16;

/// Gradients of weights, `[outputs, planes, taps]`, and of the bias.
#[derive(Debug)]
pub(crate) struct WeightGradient {
    pub(crate) weight: Vec<f32>,
    pub(crate) bias: Vec<f32>,
}

/// Sums over all images and results of `gradient` (of the pass's grid, `outputs` channels) times what
/// the taps read of `source`.
pub(super) fn weight_gradient(
    source: Source<'_>,
    planes: usize,
    images: usize,
    pass: &Pass,
    gradient: Source<'_>,
    outputs: usize,
) -> WeightGradient {
    let tiling = pass.tiling(planes, micro::longest_run());
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
                let length = tiling.columns.next_multiple_of(micro::lanes());
                let area = tiling.planes * tiling.plane();
                let needed = area + outputs * tiling.rows * length;
                if scratch.len() < needed {
                    scratch.resize(needed, 0.0);
                }
                let (taps, dy) = scratch.split_at_mut(area);
                let dy = &mut dy[..outputs * size[0] * length];
                gradient.copy_tile(image, at, size, length, dy);
                for (channel, sum) in dy.chunks_exact(size[0] * length).zip(&mut sums.bias) {
                    *sum += channel.iter().sum::<f32>();
                }
                let mut first = 0;
                while first < planes {
                    let end = (first + tiling.planes).min(planes);
                    source.fill(image, first..end, pass, &tiling, at, taps);
                    arch.dispatch(Tile {
                        taps,
                        dy,
                        offsets: &offsets[..(end - first) * pass.taps.len()],
                        first: first * pass.taps.len(),
                        all: planes * pass.taps.len(),
                        rows: size[0],
                        length,
                        outputs,
                        pass,
                        tiling: &tiling,
                        weight: &mut sums.weight,
                    });
                    first = end;
                }
            });
        }
        sums
    };
    let mut parts: Vec<WeightGradient> = (0..parts).into_par_iter().map(partial).collect();
    let mut sums = parts.swap_remove(0);
    for part in parts.split_off(0) {
        add(&mut sums.weight, &part.weight);
        add(&mut sums.bias, &part.bias);
    }
    sums
}

fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

/// The work on one filled tile.
struct Tile<'a> {
    taps: &'a [f32],
    /// `[outputs][rows][length]`, zero past the tile's columns.
    dy: &'a [f32],
    offsets: &'a [u32],
    /// Number of the first offset among `all` taps of one output.
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
        // As many output channels as registers hold.
        if S::REGISTER_COUNT >= 32 {
            self.blocks::<S, 8, TAPS>(simd);
        } else {
            self.blocks::<S, 4, TAPS>(simd);
        }
    }
}

impl Tile<'_> {
    #[inline(always)]
    fn blocks<S: Simd, const M: usize, const K: usize>(self, simd: S) {
        let channel = self.rows * self.length;
        for m in (0..self.outputs).step_by(M) {
            for k in (0..self.offsets.len()).step_by(K) {
                // The last block repeats its last channel and tap, and drops the repeats.
                let outputs: [usize; M] =
                    std::array::from_fn(|i| (m + i).min(self.outputs - 1) * channel);
                let offsets: [usize; K] = std::array::from_fn(|j| {
                    self.offsets[(k + j).min(self.offsets.len() - 1)] as usize
                });
                let mut sums = [[simd.splat_f32s(0.0); K]; M];
                for row in 0..self.rows {
                    // SAFETY: rows of `dy` are `length` long, whole vectors; so much lies in scratch
                    // after every tap of a row (`Pass::tiling`).
                    unsafe {
                        let dy =
                            outputs.map(|start| self.dy.as_ptr().add(start + row * self.length));
                        let x = self.taps.as_ptr().add(self.pass.stride * row * self.tiling.row);
                        micro::correlate(simd, dy, x, offsets, self.length, &mut sums);
                    }
                }
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
