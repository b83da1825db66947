//! Gradient of the weights of a pass in cells.
#![allow(unsafe_code)]

use super::inputs::{Reader, Transformed};
use super::run::cut;
use super::{PLACES, Tile, Tiles};
use crate::conv::micro::{self, Single};
use crate::conv::run::SCRATCH;
use crate::conv::source::Source;
use crate::conv::weight_gradient::{PARTS, WeightGradient};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::ops::Range;

/// Number of transformed values of a tile. A sixteenth of them, of one place, stays in a core's second-level
/// cache.
const TILE_VALUES: usize = 512 * 1024;

/// Minimum and maximum number of cells in a tile: every sum over them is added to the gradient once.
const CELLS: [usize; 2] = [32, 256];

/// Planes per block.
const PLANES: usize = 3;

/// Sums `gradient` times the values that the taps read from `source`, as
/// [`weight_gradient`](super::super::weight_gradient::weight_gradient) does. The sizes are planes of `source`,
/// images, and channels of `gradient`.
pub(in crate::conv) fn weight_gradient(
    source: Source<'_>,
    [planes, images, outputs]: [usize; 3],
    gradient: Source<'_>,
) -> WeightGradient {
    let most = (TILE_VALUES / PLACES / (planes + outputs)).clamp(CELLS[0], CELLS[1]);
    let tiles = Tiles::new([gradient.height, gradient.width], most);
    // Small images are taken together.
    let group = if tiles.count() == 1 { (most / tiles.cells()).clamp(1, images) } else { 1 };
    let lanes = micro::lanes();
    let stride = (group * tiles.cells()).next_multiple_of(lanes) + lanes;
    let readers = [source, gradient].map(|source| Reader::new(source, &tiles));
    let sizes = [readers[0].scratch(), PLACES * planes * stride, PLACES * outputs * stride];
    let arch = Arch::new();
    let tasks = images.div_ceil(group) * tiles.count();
    let parts = PARTS.min(tasks);
    let partial = |part: usize| {
        let mut sums = vec![0.0; PLACES * outputs * planes];
        let mut bias = vec![0.0; outputs];
        for task in part * tasks / parts..(part + 1) * tasks / parts {
            let first = task / tiles.count() * group;
            let images = first..(first + group).min(images);
            let tile = tiles.tile(task % tiles.count());
            SCRATCH.with_borrow_mut(|scratch| {
                let [scratch, inputs, gradients] = cut(scratch, sizes);
                let transformed = [inputs, gradients];
                let (sums, bias) = (&mut sums, &mut bias);
                arch.dispatch(Work {
                    readers,
                    scratch,
                    transformed,
                    stride,
                    images,
                    tile,
                    sums,
                    bias,
                });
            });
        }
        WeightGradient { weight: sums, bias }
    };
    let sums = WeightGradient::sum((0..parts).into_par_iter().map(partial).collect());
    let mut weight = vec![0.0; 9 * outputs * planes];
    weight.par_chunks_mut(9).enumerate().with_min_len(planes).for_each(|(number, weight)| {
        let places = |place| sums.weight[place * outputs * planes + number];
        weight.copy_from_slice(&weights_of(std::array::from_fn(places)));
    });
    WeightGradient { weight, bias: sums.bias }
}

/// Transforms the gradient of a plane's transformed weights: `G^T u G`.
fn weights_of(u: [f32; PLACES]) -> [f32; 9] {
    let three =
        |a: f32, b: f32, c: f32, d: f32| [a + 0.5 * (b + c), 0.5 * (b - c), 0.5 * (b + c) + d];
    let columns: [[f32; 3]; 4] =
        std::array::from_fn(|x| three(u[x], u[x + 4], u[x + 8], u[x + 12]));
    let mut weights = [0.0; 9];
    for (row, weights) in weights.chunks_exact_mut(3).enumerate() {
        let [a, b, c, d] = columns;
        weights.copy_from_slice(&three(a[row], b[row], c[row], d[row]));
    }
    weights
}

/// Work on one tile.
struct Work<'a> {
    /// Readers of the inputs and of the gradients of the results.
    readers: [Reader<'a>; 2],
    /// Scratch memory of the readers.
    scratch: &'a mut [f32],
    /// Transformed inputs `[place][plane][cell]`, and transformed gradients `[place][channel][cell]`.
    transformed: [&'a mut [f32]; 2],
    /// Number of values between planes, and between channels.
    stride: usize,
    images: Range<usize>,
    /// Tile of each of the images.
    tile: Tile,
    /// Gradients of the transformed weights, `[place][channel][plane]`.
    sums: &'a mut [f32],
    bias: &'a mut [f32],
}

impl WithSimd for Work<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The block has as many channels as registers hold.
        if S::REGISTER_COUNT >= 32 {
            self.multiply::<S, 8>(simd);
        } else {
            self.multiply::<S, 4>(simd);
        }
    }
}

impl Work<'_> {
    /// Transforms the tile and adds the products of all blocks of `M` channels.
    #[inline(always)]
    fn multiply<S: Simd, const M: usize>(self, simd: S) {
        let (tile, stride) = (self.tile, self.stride);
        let outputs = self.bias.len();
        let planes = self.sums.len() / PLACES / outputs;
        let ([source, gradient], [inputs, gradients]) = (self.readers, self.transformed);
        let cells = self.images.len() * tile.cells();
        for (number, image) in self.images.enumerate() {
            let first = number * tile.cells();
            let mut to = Transformed { values: &mut *inputs, stride, first };
            source.transform(simd, [image, planes], tile, self.scratch, &mut to);
            let mut to = Transformed { values: &mut *gradients, stride, first };
            gradient.transform_gradients(simd, image, tile, self.scratch, &mut to, self.bias);
        }
        let length = cells.next_multiple_of(S::F32_LANES);
        for values in [&mut *inputs, &mut *gradients] {
            values.chunks_exact_mut(stride).for_each(|plane| plane[cells..length].fill(0.0));
        }
        for place in 0..PLACES {
            let inputs = &inputs[place * planes * stride..][..planes * stride];
            let gradients = &gradients[place * outputs * stride..][..outputs * stride];
            let sums = &mut self.sums[place * outputs * planes..][..outputs * planes];
            for m in (0..outputs).step_by(M) {
                for k in (0..planes).step_by(PLANES) {
                    // The last block repeats its last channel and plane, and drops the repeats.
                    let channels: [usize; M] = std::array::from_fn(|i| (m + i).min(outputs - 1));
                    let offsets: [usize; PLANES] =
                        std::array::from_fn(|j| (k + j).min(planes - 1) * stride);
                    // SAFETY: planes and channels are `stride` long, which whole vectors of cells fill.
                    let products = unsafe {
                        let dy = channels.map(|channel| gradients.as_ptr().add(channel * stride));
                        let x = inputs.as_ptr();
                        micro::correlate::<S, Single, f32, M, PLANES>(
                            simd,
                            dy,
                            x,
                            offsets,
                            [1, length, 0],
                        )
                    };
                    for (i, products) in products.iter().enumerate().take(outputs - m) {
                        for (j, &product) in products.iter().enumerate().take(planes - k) {
                            sums[(m + i) * planes + k + j] += simd.reduce_sum_f32s(product);
                        }
                    }
                }
            }
        }
    }
}
