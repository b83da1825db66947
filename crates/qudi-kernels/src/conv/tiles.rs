//! Convolution with tiles of a processor's matrix unit (AMX).
//!
//! A tile of weights holds 16 output channels by up to 16 pairs of planes. Times a tile of scratch memory,
//! the same pairs by 16 neighbouring pixels, it adds to 16 channels by 16 pixels. Scratch memory holds pairs
//! of planes. A tile's rows are read there with the plane's stride, at the offset of each tap, and results
//! are stored as planes. Nothing is unfolded or transposed.
#![allow(unsafe_code)]

use super::run::Tile;
use rayon::prelude::*;

/// Channels of a block: two tiles.
pub(super) const OUTPUTS: usize = 2 * SIDE;
/// Pixels of a block: two tiles.
pub(super) const PIXELS: usize = 2 * SIDE;

/// Rows of a tile, and 32-bit entries per row.
pub(super) const SIDE: usize = 16;

/// Row of a tile of weights, in one cache line: pairs of planes of one channel.
#[repr(C, align(64))]
#[derive(Clone, Debug)]
pub(super) struct Row(pub(super) [f32; SIDE]);

/// Sums of a block, `[channel][pixel]`.
#[repr(C, align(64))]
#[derive(Clone, Debug)]
pub(super) struct Sums(pub(super) [[f32; PIXELS]; OUTPUTS]);

/// Operands of a block.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block<'a> {
    /// Tiles of weights for every offset.
    pub(super) weights: *const Row,
    /// Numbers of tiles of weights and of pixels, one or two each.
    pub(super) tiles: [usize; 2],
    /// First pixel of the block in the first scratch plane.
    pub(super) pixels: *const f32,
    /// Offsets from `pixels` of a group's first plane, for each tap.
    pub(super) offsets: &'a [u32],
    /// Pairs of planes per group.
    pub(super) group: usize,
    /// Entries between neighbouring scratch planes.
    pub(super) plane: usize,
}

/// Operands of a part of the weight gradient: sixteen planes, read at one tap, times sixteen channels of the
/// gradient.
#[derive(Clone, Copy, Debug)]
pub(super) struct Correlation {
    /// First pixel of each tile in its first scratch plane.
    pub(super) pixels: [*const u16; 2],
    /// First row of gradients of each tile.
    pub(super) gradients: [*const Row; 2],
    /// Numbers of tiles of planes and of gradients, one or two each.
    pub(super) tiles: [usize; 2],
    /// Values between neighbouring scratch planes.
    pub(super) plane: usize,
    /// Number of lines.
    pub(super) lines: usize,
    /// Values between neighbouring lines in scratch memory.
    pub(super) steps: usize,
    pub(super) line: usize,
}

/// Sums of a tile of weights, `[plane][channel]`.
pub(super) type WeightSums = [Row; SIDE];

/// A matrix unit or its model.
pub(super) trait MatrixUnit {
    /// Computes the sums of a block. With one tile of weights it computes only the first 16 channels, with
    /// one tile of pixels only the first 16 pixels.
    ///
    /// # Safety
    /// The machine must have the unit. All tiles must be readable.
    unsafe fn multiply(&self, block: &Block<'_>, sums: &mut Sums);

    /// Adds the products of all tiles of planes and all tiles of channels to `sums`.
    ///
    /// # Safety
    /// The machine must have the unit, configured for groups of [`SIDE`]. All tiles of pixels and gradients,
    /// and as many sums, must be valid.
    unsafe fn correlate(&self, what: &Correlation, sums: [[*mut WeightSums; 2]; 2]);
}

/// Packs weights as tiles, `[block][group][tap][tile of channels][channel][pair]`. The last block has one
/// tile of channels if that is enough.
pub(super) fn packed(
    outputs: usize,
    planes: usize,
    group: usize,
    taps: usize,
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> Vec<Row> {
    let rows_per_channel = planes / group * taps;
    let mut rows =
        vec![const { Row([0.0; SIDE]) }; outputs.next_multiple_of(SIDE) * rows_per_channel];
    // A convolution without inputs or taps has no weights.
    let size = (OUTPUTS * rows_per_channel).max(1);
    rows.par_chunks_mut(size).enumerate().for_each(|(block, rows)| {
        let channels = rows.len() / rows_per_channel;
        for (number, rows) in rows.chunks_exact_mut(taps * channels).enumerate() {
            for channel in 0..channels {
                for pair in 0..group {
                    for tap in 0..taps {
                        rows[tap * channels + channel].0[pair] =
                            weight(block * OUTPUTS + channel, number * group + pair, tap);
                    }
                }
            }
        }
    });
    rows
}

/// Computes all blocks of a tile of the image.
///
/// # Safety
/// The machine must have the unit.
#[inline(always)]
pub(super) unsafe fn blocks(unit: &impl MatrixUnit, tile: &Tile<'_>, group: usize) {
    let taps = tile.pass.taps.len();
    let (start, _, planes) = tile.planes;
    let mut sums = Sums([[0.0; PIXELS]; OUTPUTS]);
    for first in (0..tile.weights.outputs).step_by(OUTPUTS) {
        let tiles = (tile.weights.outputs - first).div_ceil(SIDE).min(2);
        let before = first / SIDE * planes / group + tiles * start / group;
        let weights = &tile.weights.tiles[before * taps * SIDE..];
        debug_assert!(weights.len() >= tiles * tile.offsets.len() * SIDE);
        for row in 0..tile.size[0] {
            for column in (0..tile.size[1]).step_by(PIXELS) {
                let base = tile.pass.stride * row * tile.tiling.row + column;
                let count = PIXELS.min(tile.size[1] - column);
                // SAFETY: a scratch row holds whole blocks past the tile's last column.
                unsafe {
                    let block = Block {
                        weights: weights.as_ptr(),
                        tiles: [tiles, count.div_ceil(SIDE)],
                        pixels: tile.scratch.as_ptr().add(base),
                        offsets: tile.offsets,
                        group,
                        plane: tile.tiling.plane(),
                    };
                    unit.multiply(&block, &mut sums);
                }
                for (m, sums) in sums.0.iter_mut().enumerate().take(tile.weights.outputs - first) {
                    tile.finish(first + m, row, column, &mut sums[..count]);
                }
            }
        }
    }
}

/// Unpacks the two numbers of a pair.
fn halves(bits: f32) -> [f32; 2] {
    let bits = bits.to_bits();
    [f32::from_bits(bits << 16), f32::from_bits(bits & 0xffff_0000)]
}

/// Model of the unit with plain loops, for tests on machines without it.
#[derive(Debug)]
pub(super) struct Model;

impl MatrixUnit for Model {
    unsafe fn multiply(&self, block: &Block<'_>, sums: &mut Sums) {
        for (channel, sums) in sums.0.iter_mut().enumerate().take(block.tiles[0] * SIDE) {
            sums[..block.tiles[1] * SIDE].fill(0.0);
            for (step, &offset) in block.offsets.iter().enumerate() {
                for plane in 0..block.group {
                    // SAFETY: the caller's promise.
                    let weight = unsafe {
                        (*block.weights.add(step * block.tiles[0] * SIDE + channel)).0[plane]
                    };
                    let weight = halves(weight);
                    for (pixel, sum) in sums[..block.tiles[1] * SIDE].iter_mut().enumerate() {
                        // SAFETY: the caller's promise.
                        let value = unsafe {
                            *block.pixels.add(offset as usize + plane * block.plane + pixel)
                        };
                        let value = halves(value);
                        *sum += weight[0] * value[0] + weight[1] * value[1];
                    }
                }
            }
        }
    }

    unsafe fn correlate(&self, what: &Correlation, sums: [[*mut WeightSums; 2]; 2]) {
        let value = |bits: u16| f32::from_bits(u32::from(bits) << 16);
        for (p, &pixels) in what.pixels.iter().enumerate().take(what.tiles[0]) {
            for (c, &gradients) in what.gradients.iter().enumerate().take(what.tiles[1]) {
                // SAFETY: the caller's promise.
                let sums = unsafe { &mut *sums[p][c] };
                for pair in 0..what.lines * what.steps * SIDE {
                    let (line, column) = (pair / (what.steps * SIDE), pair % (what.steps * SIDE));
                    // SAFETY: as above.
                    let gradients = unsafe { &(*gradients.add(pair)).0 };
                    for (plane, sums) in sums.iter_mut().enumerate() {
                        let place = plane * what.plane + line * what.line + 2 * column;
                        // SAFETY: as above.
                        let pixels = unsafe { [*pixels.add(place), *pixels.add(place + 1)] };
                        for (sum, gradient) in sums.0.iter_mut().zip(gradients) {
                            let [low, high] = halves(*gradient);
                            *sum += value(pixels[0]) * low + value(pixels[1]) * high;
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::conv::{Geometry, native};
    use crate::matrix_units::{MatrixUnits, with_matrix_units};

    /// Generates reproducible numbers in [-1, 1).
    fn numbers(seed: usize, count: usize) -> Vec<f32> {
        let mut state = (seed as u32).wrapping_mul(2_654_435_769) | 1;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            state as f32 / 2f32.powi(31) - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    fn assert_close(got: &[f32], expected: &[f32], about: &Geometry) {
        let scale = expected.iter().fold(1e-3f32, |scale, value| scale.max(value.abs()));
        assert_eq!(got.len(), expected.len(), "{about:?}");
        for (got, expected) in got.iter().zip(expected) {
            assert!((got - expected).abs() < 3e-6 * scale, "{got} and {expected}: {about:?}");
        }
    }

    /// Compares sums over tiles, computed by the model of the matrix unit, with sums over rounded numbers.
    #[test]
    fn tiles_cover_every_shape() {
        // Channels of the inputs, outputs, frames, rows and columns, kernel, stride.
        #[allow(clippy::type_complexity)]
        let shapes: [(&[usize], usize, usize, [usize; 2], [usize; 3], usize); 9] = [
            (&[1], 1, 1, [1, 1], [1, 1, 1], 1),
            (&[3, 4], 5, 2, [7, 9], [1, 3, 3], 1),
            (&[32], 32, 1, [5, 33], [1, 3, 3], 1),
            (&[33, 8], 17, 2, [12, 70], [1, 3, 3], 2),
            (&[40], 40, 1, [16, 16], [1, 3, 3], 1),
            (&[120], 48, 1, [9, 31], [1, 1, 1], 1),
            (&[16], 33, 2, [20, 21], [1, 7, 7], 1),
            (&[2], 16, 5, [11, 13], [5, 5, 5], 1),
            (&[300, 40], 40, 1, [40, 130], [1, 3, 3], 1), // more planes than scratch memory holds at once
        ];
        for (seed, (channels, outputs, frames, grid, kernel, stride)) in
            shapes.into_iter().enumerate()
        {
            let geometry = Geometry {
                images: 2 * frames,
                frames,
                channels: channels.to_vec(),
                height: grid[0],
                width: grid[1],
                outputs,
                kernel,
                stride,
                addend: true,
                relu: true,
                bf16: true,
            };
            let plane = geometry.images * grid[0] * grid[1];
            let results = geometry.images * geometry.output_grid().iter().product::<usize>();
            let inputs = channels.iter().enumerate();
            let mut inputs: Vec<_> =
                inputs.map(|(i, c)| numbers(10 * seed + i, c * plane)).collect();
            inputs.push(numbers(10 * seed + 5, outputs * results));
            let inputs: Vec<&[f32]> = inputs.iter().map(Vec::as_slice).collect();
            let weight = numbers(10 * seed + 6, outputs * geometry.taps());
            let bias = numbers(10 * seed + 7, outputs);
            let gradient = numbers(10 * seed + 8, outputs * results);
            let run = |units| {
                let run = || {
                    let output = native::forward(&geometry, &inputs, &weight, &bias);
                    let of_inputs =
                        native::input_gradients(&geometry, &weight, &gradient, Some(&gradient));
                    let of_weights = native::weight_gradients(
                        &geometry,
                        &inputs[..channels.len()],
                        &gradient,
                        Some(&gradient),
                    );
                    (output, of_inputs, of_weights)
                };
                with_matrix_units(units, run).expect("the model is there")
            };
            let ((output, of_inputs, of_weights), expected) =
                (run(MatrixUnits::Amx), run(MatrixUnits::F32));
            assert_close(&output, &expected.0, &geometry);
            for (got, expected) in of_inputs.iter().zip(&expected.1) {
                assert_close(got, expected, &geometry);
            }
            assert_close(&of_weights.weight, &expected.2.weight, &geometry);
            assert_close(&of_weights.bias, &expected.2.bias, &geometry);
        }
    }
}
