//! Execution of a pass in cells.
// Plain indices instead of iterators and closures, which are not compiled for the vector unit.
#![allow(unsafe_code, clippy::needless_range_loop)]

use super::inputs::{Reader, Transformed, read};
use super::{PLACES, Tile, Tiles};
use crate::conv::micro::{self, BlockWork, Single, in_blocks};
use crate::conv::pass::Pass;
use crate::conv::run::{Finish, SCRATCH, Target};
use crate::conv::source::Source;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Number of transformed inputs of a tile: a quarter of a megabyte, which stays in a core's second-level
/// cache.
const TILE_VALUES: usize = 64 * 1024;

/// Minimum number of cells in a tile, since tiles read their borders, too.
const MIN_CELLS: usize = 32;

/// A pass of 3 x 3 taps, cut into tiles of cells, with its weights transformed.
#[derive(Clone, Debug)]
pub(in crate::conv) struct Packed {
    /// Weights `[block][place][plane][channel of the block]`.
    values: Vec<f32>,
    /// Block size in channels and vectors of cells.
    block: (usize, usize),
    outputs: usize,
    planes: usize,
    tiles: Tiles,
    /// Number of values between planes of transformed inputs, and between products of a channel.
    stride: usize,
}

impl Packed {
    /// Packs the weights `weight(output, plane, tap)` of `planes` input planes.
    pub(in crate::conv) fn new(
        pass: &Pass,
        outputs: usize,
        planes: usize,
        weight: impl Fn(usize, usize, usize) -> f32 + Sync,
    ) -> Self {
        let most = (TILE_VALUES / PLACES / planes).max(MIN_CELLS);
        let tiles = Tiles::new(pass.grid, most);
        let block = micro::block(outputs, tiles.cells());
        let lanes = micro::lanes();
        let stride = tiles.cells().next_multiple_of(block.1 * lanes) + lanes;
        let channels = block.0;
        let mut values = vec![0.0; outputs.next_multiple_of(channels) * PLACES * planes];
        let size = (channels * PLACES * planes).max(1);
        values.par_chunks_mut(size).enumerate().for_each(|(number, values)| {
            for plane in 0..planes {
                for m in 0..channels.min(outputs - number * channels) {
                    let output = number * channels + m;
                    let taps = std::array::from_fn(|tap| weight(output, plane, tap));
                    for (place, value) in transformed_weights(taps).into_iter().enumerate() {
                        values[(place * planes + plane) * channels + m] = value;
                    }
                }
            }
        });
        Self { values, block, outputs, planes, tiles, stride }
    }
}

/// Transforms the weights of a plane: `G g G^T`.
fn transformed_weights(g: [f32; 9]) -> [f32; PLACES] {
    let four = |a: f32, b: f32, c: f32| [a, 0.5 * (a + b + c), 0.5 * (a - b + c), c];
    let columns: [[f32; 4]; 3] = std::array::from_fn(|x| four(g[x], g[x + 3], g[x + 6]));
    let mut values = [0.0; PLACES];
    for (row, values) in values.chunks_exact_mut(4).enumerate() {
        values.copy_from_slice(&four(columns[0][row], columns[1][row], columns[2][row]));
    }
    values
}

/// Correlates `source` with `weights` over `images` images, as [`run`](super::run::run) does.
pub(in crate::conv) fn run(
    source: Source<'_>,
    images: usize,
    weights: &Packed,
    finish: Finish<'_>,
    target: &Target,
) {
    let tiles = weights.tiles;
    let offsets: Vec<u32> =
        (0..weights.planes).map(|plane| (plane * weights.stride) as u32).collect();
    let reader = Reader::new(source, &tiles);
    let sizes = [
        reader.scratch(),
        PLACES * weights.planes * weights.stride,
        PLACES * weights.block.0 * weights.stride,
    ];
    let arch = Arch::new();
    (0..images * tiles.count()).into_par_iter().for_each(|task| {
        let (image, number) = (task / tiles.count(), task % tiles.count());
        let (tile, offsets) = (tiles.tile(number), offsets.as_slice());
        SCRATCH.with_borrow_mut(|scratch| {
            let [plane, inputs, products] = cut(scratch, sizes);
            let work = Work {
                reader,
                plane,
                inputs,
                products,
                offsets,
                weights,
                finish,
                target,
                image,
                tile,
            };
            arch.dispatch(work);
        });
    });
}

/// Cuts scratch memory into slices of these sizes.
pub(super) fn cut<const N: usize>(scratch: &mut Vec<f32>, sizes: [usize; N]) -> [&mut [f32]; N] {
    let needed = sizes.iter().sum();
    if scratch.len() < needed {
        scratch.resize(needed, 0.0);
    }
    let mut rest = scratch.as_mut_slice();
    sizes.map(|size| rest.split_off_mut(..size).unwrap_or_default())
}

/// Work on one tile.
struct Work<'a> {
    reader: Reader<'a>,
    /// Scratch memory of the reader.
    plane: &'a mut [f32],
    /// Transformed inputs `[place][plane][cell]`.
    inputs: &'a mut [f32],
    /// Products `[place][channel of the block][cell]`, summed over the planes.
    products: &'a mut [f32],
    /// Where the transformed inputs of every plane begin.
    offsets: &'a [u32],
    weights: &'a Packed,
    finish: Finish<'a>,
    target: &'a Target,
    image: usize,
    tile: Tile,
}

impl WithSimd for Work<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Packed { planes, stride, .. } = *self.weights;
        let mut inputs = Transformed { values: &mut *self.inputs, stride, first: 0 };
        self.reader.transform(simd, [self.image, planes], self.tile, self.plane, &mut inputs);
        // SAFETY: inputs and products are as long as the weights ask for.
        unsafe { in_blocks(simd, self.weights.block, self) }
    }
}

impl<S: Simd> BlockWork<S> for Work<'_> {
    #[inline(always)]
    unsafe fn blocks<const M: usize, const V: usize>(self, simd: S) {
        let Packed { planes, stride, outputs, .. } = *self.weights;
        let cells = self.tile.cells();
        let run = V * S::F32_LANES;
        let zero = simd.splat_f32s(0.0);
        for first in (0..outputs).step_by(M) {
            for place in 0..PLACES {
                let start = (first * PLACES + place * M) * planes;
                let weights = &self.weights.values[start..start + planes * M];
                for cell in (0..cells).step_by(run) {
                    let mut sums = [[zero; V]; M];
                    // SAFETY: planes hold whole runs (`Packed::new`), and so do products.
                    unsafe {
                        let inputs = self.inputs.as_ptr().add(place * planes * stride + cell);
                        micro::accumulate::<S, Single, M, V>(
                            simd,
                            inputs,
                            self.offsets,
                            weights.as_ptr(),
                            &mut sums,
                        );
                        let to = self.products.as_mut_ptr();
                        for (m, sum) in sums.into_iter().enumerate() {
                            let to = to.add((place * M + m) * stride + cell);
                            micro::store::<S, V>(sum, to, run);
                        }
                    }
                }
            }
            for m in 0..M.min(outputs - first) {
                self.transform_products(simd, m, M, first + m);
            }
        }
    }
}

impl Work<'_> {
    /// Transforms the products of channel `m` of a block of `channels` into results: `A^T m A`.
    #[inline(always)]
    fn transform_products<S: Simd>(&self, simd: S, m: usize, channels: usize, output: usize) {
        let stride = self.weights.stride;
        for row in 0..self.tile.rows {
            for column in (0..self.tile.columns).step_by(S::F32_LANES) {
                let cell = row * self.tile.columns + column;
                let mut halves = [[simd.splat_f32s(0.0); 2]; 4];
                for i in 0..4 {
                    let mut values = [halves[0][0]; 4];
                    for j in 0..4 {
                        let place = ((4 * i + j) * channels + m) * stride + cell;
                        // SAFETY: there are `lanes` values more than cells.
                        values[j] = unsafe { read::<S>(self.products.as_ptr().add(place)) };
                    }
                    halves[i] = two(simd, values);
                }
                let [a, b, c, d] = halves;
                let even = two(simd, [a[0], b[0], c[0], d[0]]);
                let odd = two(simd, [a[1], b[1], c[1], d[1]]);
                let rows = [[even[0], odd[0]], [even[1], odd[1]]];
                self.write(simd, [row, column], output, rows);
            }
        }
    }

    /// Writes two rows of results, given by their even and odd columns.
    #[inline(always)]
    fn write<S: Simd>(
        &self,
        simd: S,
        [row, column]: [usize; 2],
        output: usize,
        rows: [[S::f32s; 2]; 2],
    ) {
        let left = 2 * (self.tile.at[1] + column);
        let cells = S::F32_LANES.min(self.tile.columns - column);
        let count = (2 * cells).min(self.target.width - left);
        let top = 2 * (self.tile.at[0] + row);
        let bias = simd.splat_f32s(self.finish.bias.map_or(0.0, |bias| bias[output]));
        for (y, [even, odd]) in (top..self.target.height).zip(rows) {
            let mut line = joined::<S>(simd.add_f32s(even, bias), simd.add_f32s(odd, bias));
            if let Some(addend) = self.finish.addend {
                let channel = self.image * self.weights.outputs + output;
                let from = (channel * self.target.height + y) * self.target.width + left;
                let line: &mut [f32] = pulp::bytemuck::cast_slice_mut(&mut line);
                for (value, addend) in line.iter_mut().zip(&addend[from..from + count]) {
                    *value += addend;
                }
            }
            if self.finish.relu {
                let zero = simd.splat_f32s(0.0);
                line = [simd.max_f32s(line[0], zero), simd.max_f32s(line[1], zero)];
            }
            // SAFETY: the tile lies within the target, and no other tile writes there.
            unsafe {
                let to = self.target.plane(self.image, output).add(y * self.target.width + left);
                micro::store::<S, 2>(line, to, count);
            }
        }
    }
}

/// Computes `A^T m`.
#[inline(always)]
fn two<S: Simd>(simd: S, [a, b, c, d]: [S::f32s; 4]) -> [S::f32s; 2] {
    [simd.add_f32s(simd.add_f32s(a, b), c), simd.sub_f32s(simd.sub_f32s(b, c), d)]
}

/// Interleaves two vectors.
#[inline(always)]
fn joined<S: Simd>(even: S::f32s, odd: S::f32s) -> [S::f32s; 2] {
    let mut line = [even, odd];
    let values: &mut [f32] = pulp::bytemuck::cast_slice_mut(&mut line);
    let halves = [even, odd];
    let halves: &[f32] = pulp::bytemuck::cast_slice(&halves);
    for i in 0..S::F32_LANES {
        values[2 * i] = halves[i];
        values[2 * i + 1] = halves[S::F32_LANES + i];
    }
    line
}
