//! Gradient of a convolution's weights with tiles of a processor's matrix unit (AMX).
//!
//! A tile of sixteen planes by 32 neighbouring pixels, read at one tap, times a tile of the same pixels by
//! sixteen channels of the gradient, adds to sixteen planes by sixteen channels. Planes are stored in scratch
//! memory unchanged but for rounding to bfloat16: every tap reads its tiles there at its own offset.
//! Gradients are transposed once.
#![allow(unsafe_code)]

use super::pass::{Pass, Tiling};
use super::run::SCRATCH;
use super::scratch::{Format, Narrow, pair};
use super::source::Source;
use super::tiles::{Correlation, MatrixUnit, PIXELS, Row, SIDE, WeightSums};
use super::weight_gradient::{PARTS, WeightGradient};
use pulp::{Arch, Simd, WithSimd, bytemuck};
use rayon::prelude::*;
use std::array;
use std::cell::RefCell;
use std::ops::Range;

thread_local! {
    /// Buffer of transposed gradients, reused by the next call on this thread.
    static TRANSPOSED: RefCell<Vec<Row>> = const { RefCell::new(Vec::new()) };
}

/// Computes [`super::weight_gradient::weight_gradient`] in bfloat16.
pub(super) fn weight_gradient(
    source: Source<'_>,
    [planes, images, outputs]: [usize; 3],
    pass: &Pass,
    gradient: Source<'_>,
) -> WeightGradient {
    let mut tiling = pass.tiling(Format::Single, planes, SIDE);
    if tiling.planes < planes {
        tiling.planes = (tiling.planes / SIDE * SIDE).max(SIDE);
    }
    let lines = Lines::new(pass, &tiling);
    let offsets = tiling.offsets(pass, 1);
    let tasks = images * tiling.count();
    let parts = PARTS.min(tasks);
    let sizes = [pass.taps.len(), planes.div_ceil(SIDE), outputs.div_ceil(SIDE)];
    let partial = |part: usize| {
        let mut sums = vec![[const { Row([0.0; SIDE]) }; SIDE]; sizes.iter().product()];
        let mut bias = vec![0.0; outputs];
        for task in part * tasks / parts..(part + 1) * tasks / parts {
            let (image, number) = (task / tiling.count(), task % tiling.count());
            let (at, size) = tiling.tile(number, pass.grid);
            let rows = lines.turned(outputs, size[0]);
            TRANSPOSED.with_borrow_mut(|turned| {
                if turned.len() < rows {
                    turned.resize(rows, Row([0.0; SIDE]));
                }
                let turned = &mut turned[..rows];
                lines.turn(&gradient, image, at, size, turned, &mut bias);
                for first in (0..planes).step_by(tiling.planes) {
                    let planes = first..(first + tiling.planes).min(planes);
                    with_planes(&source, image, planes.clone(), pass, &tiling, at, |pixels| {
                        let work = Work {
                            pixels,
                            turned,
                            lines: &lines,
                            rows: size[0],
                            tiling: &tiling,
                            offsets: &offsets,
                            first: first / SIDE,
                            tiles: planes.len().div_ceil(SIDE),
                            sizes,
                        };
                        work.run(&mut sums);
                    });
                }
            });
        }
        (sums, bias)
    };
    let parts: Vec<_> = (0..parts).into_par_iter().map(partial).collect();
    let mut parts = parts.into_iter();
    let (mut sums, mut bias) = parts.next().unwrap_or_default();
    for (more, of_bias) in parts {
        for (sum, more) in sums.iter_mut().flatten().zip(more.iter().flatten()) {
            sum.0.iter_mut().zip(more.0).for_each(|(sum, more)| *sum += more);
        }
        bias.iter_mut().zip(of_bias).for_each(|(sum, more)| *sum += more);
    }
    let [taps, plane_tiles, output_tiles] = sizes;
    let mut weight = Vec::with_capacity(outputs * planes * taps);
    for output in 0..outputs {
        for plane in 0..planes {
            for tap in 0..taps {
                let tile = (tap * plane_tiles + plane / SIDE) * output_tiles + output / SIDE;
                weight.push(sums[tile][plane % SIDE].0[output % SIDE]);
            }
        }
    }
    WeightGradient { weight, bias }
}

/// Layout of a tile's pixels in products.
struct Lines {
    /// Values between neighbouring rows of the gradient.
    pitch: usize,
    /// True if all rows form one line; otherwise each row is its own line.
    joined: bool,
    /// Scratch values between neighbouring rows of results.
    line: usize,
}

impl Lines {
    /// Chooses the layout. With stride 1, rows of the gradient get the pitch of scratch memory, with zeros
    /// between them.
    fn new(pass: &Pass, tiling: &Tiling) -> Self {
        let joined = pass.stride == 1;
        let pitch = if joined { tiling.row } else { tiling.columns.next_multiple_of(PIXELS) };
        Self { pitch, joined, line: pass.stride * tiling.row }
    }

    /// Returns the number of lines of a tile with `rows` rows, and the number of products per line.
    fn count(&self, rows: usize) -> [usize; 2] {
        if self.joined {
            [1, (rows * self.pitch).div_ceil(PIXELS)]
        } else {
            [rows, self.pitch / PIXELS]
        }
    }

    /// Returns the number of rows that the transposed gradients of `outputs` channels take.
    fn turned(&self, outputs: usize, rows: usize) -> usize {
        let [lines, steps] = self.count(rows);
        outputs.div_ceil(SIDE) * lines * steps * SIDE
    }

    /// Transposes a tile of the gradient to `[tile of channels][pair of pixels][channel]`, and adds its sum
    /// to `bias`.
    fn turn(
        &self,
        gradient: &Source<'_>,
        image: usize,
        at: [usize; 2],
        size: [usize; 2],
        turned: &mut [Row],
        bias: &mut [f32],
    ) {
        let [lines, steps] = self.count(size[0]);
        let (used, length) = (size[0] * self.pitch, lines * steps * PIXELS);
        let outputs = bias.len();
        SCRATCH.with_borrow_mut(|scratch| {
            if scratch.len() < outputs * used {
                scratch.resize(outputs * used, 0.0);
            }
            let values = &mut scratch[..outputs * used];
            gradient.copy_tile(image, at, size, self.pitch, values);
            for (channel, sum) in values.chunks_exact(used).zip(bias) {
                *sum += channel.iter().sum::<f32>();
            }
            let channels = values.chunks(SIDE * used).zip(turned.chunks_exact_mut(length / 2));
            for (values, turned) in channels {
                Arch::new().dispatch(Turn { values, used, turned });
            }
        });
    }
}

/// Transposition of up to sixteen channels of `used` values each: one row for every pair of values.
struct Turn<'a> {
    values: &'a [f32],
    used: usize,
    turned: &'a mut [Row],
}

impl WithSimd for Turn<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (block, turned) in self.turned.chunks_exact_mut(SIDE).enumerate() {
            let start = (block * PIXELS).min(self.used);
            let end = (start + PIXELS).min(self.used);
            let mut square = [[0.0f32; SIDE]; SIDE];
            for (row, channel) in square.iter_mut().zip(self.values.chunks_exact(self.used)) {
                let mut pixels = [0.0; PIXELS];
                pixels[..end - start].copy_from_slice(&channel[start..end]);
                for (to, two) in row.iter_mut().zip(pixels.chunks_exact(2)) {
                    *to = pair(two[0], two[1]);
                }
            }
            transposed(&mut square);
            for (row, values) in turned.iter_mut().zip(square) {
                row.0 = values;
            }
        }
    }
}

/// Transposes a square: exchanges its halves, then its quarters, down to single values.
#[inline(always)]
fn transposed(square: &mut [[f32; SIDE]; SIDE]) {
    exchanged::<8>(square);
    exchanged::<4>(square);
    exchanged::<2>(square);
    exchanged::<1>(square);
}

#[inline(always)]
fn exchanged<const SIZE: usize>(square: &mut [[f32; SIDE]; SIDE]) {
    for row in (0..SIDE).filter(|row| row & SIZE == 0) {
        let (upper, lower) = (square[row], square[row + SIZE]);
        let pick = |column: usize, a: f32, b: f32| if column & SIZE == 0 { a } else { b };
        square[row] = std::array::from_fn(|c| pick(c, upper[c], lower[c ^ SIZE]));
        square[row + SIZE] = std::array::from_fn(|c| pick(c, upper[c ^ SIZE], lower[c]));
    }
}

/// Calls `run` with the planes of a tile in bfloat16, followed by finite values that products may read.
fn with_planes(
    source: &Source<'_>,
    image: usize,
    planes: Range<usize>,
    pass: &Pass,
    tiling: &Tiling,
    at: [usize; 2],
    run: impl FnOnce(&[u16]),
) {
    let area = planes.len() * tiling.plane();
    // Tiles hold sixteen planes, and products read past the last row.
    let all = planes.len().next_multiple_of(SIDE) * tiling.plane() + past(tiling);
    SCRATCH.with_borrow_mut(|scratch| {
        let needed = area + all.div_ceil(2);
        if scratch.len() < needed {
            scratch.resize(needed, 0.0);
        }
        let (values, narrow) = scratch[..needed].split_at_mut(area);
        source.fill(image, planes, pass, tiling, at, values);
        let narrow: &mut [u16] = bytemuck::cast_slice_mut(narrow);
        Arch::new().dispatch(Narrow { from: values, to: &mut narrow[..area] });
        let end = (area + past(tiling)).min(narrow.len());
        narrow[area..end].fill(0);
        run(narrow);
    });
}

/// Returns the number of values that products read past a plane: the rest of a row of taps, and of a product.
fn past(tiling: &Tiling) -> usize {
    2 * tiling.row + 2 * PIXELS
}

/// Work on one tile whose planes and gradients are in memory.
pub(super) struct Work<'a> {
    pixels: &'a [u16],
    turned: &'a [Row],
    lines: &'a Lines,
    rows: usize,
    tiling: &'a Tiling,
    /// Offsets of the taps in a plane.
    offsets: &'a [u32],
    /// Index of the first tile of planes.
    first: usize,
    tiles: usize,
    /// Numbers of taps, of tiles of all planes, and of tiles of channels.
    sizes: [usize; 3],
}

impl Work<'_> {
    fn run(&self, sums: &mut [WeightSums]) {
        #[cfg(all(target_arch = "x86_64", not(test)))]
        // SAFETY: this path is taken only where the processor has the unit, and the process may use it.
        unsafe {
            super::amx::correlate(self, sums);
        }
        #[cfg(any(not(target_arch = "x86_64"), test))]
        // SAFETY: a model needs no unit.
        unsafe {
            self.correlate(&super::tiles::Model, sums);
        }
    }

    /// Adds the products of the tile to `sums`.
    ///
    /// # Safety
    /// The machine must have the unit.
    #[inline(always)]
    pub(super) unsafe fn correlate(&self, unit: &impl MatrixUnit, sums: &mut [WeightSums]) {
        let [_, plane_tiles, output_tiles] = self.sizes;
        let [lines, steps] = self.lines.count(self.rows);
        let plane = self.tiling.plane();
        for (tap, &offset) in self.offsets.iter().enumerate() {
            for planes in (0..self.tiles).step_by(2) {
                for channels in (0..output_tiles).step_by(2) {
                    // The last block repeats its last tile, and drops the repeat.
                    let tile = |number: usize| (planes + number).min(self.tiles - 1);
                    let channel = |number: usize| (channels + number).min(output_tiles - 1);
                    let places: [[usize; 2]; 2] = array::from_fn(|p| {
                        let row = (tap * plane_tiles + self.first + tile(p)) * output_tiles;
                        array::from_fn(|c| row + channel(c))
                    });
                    let what = Correlation {
                        pixels: array::from_fn(|p| {
                            self.pixels[tile(p) * SIDE * plane + offset as usize..].as_ptr()
                        }),
                        gradients: array::from_fn(|c| {
                            self.turned[channel(c) * lines * steps * SIDE..].as_ptr()
                        }),
                        tiles: [(self.tiles - planes).min(2), (output_tiles - channels).min(2)],
                        plane,
                        lines,
                        steps,
                        line: self.lines.line,
                    };
                    let sums = places.map(|row| row.map(|place| &raw mut sums[place]));
                    // SAFETY: tiles of planes and gradients lie in their slices (`with_planes`).
                    unsafe { unit.correlate(&what, sums) };
                }
            }
        }
    }
}
