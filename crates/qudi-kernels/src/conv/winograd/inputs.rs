//! Rows of images, split into even and odd columns, and the transformed inputs of cells.
// Plain indices instead of iterators and closures, which are not compiled for the vector unit.
#![allow(unsafe_code, clippy::needless_range_loop)]

use super::{PLACES, Tile, Tiles};
use crate::conv::micro;
use crate::conv::scratch::{Row, copy};
use crate::conv::source::Source;
use pulp::Simd;

/// Number of pairs that are split at once.
const RUN: usize = 8;

/// Transformed values of tiles, `[place][plane][cell]`.
#[derive(Debug)]
pub(super) struct Transformed<'a> {
    pub(super) values: &'a mut [f32],
    /// Number of values per plane; a vector may be written after the last cell.
    pub(super) stride: usize,
    /// Place of a tile's first cell.
    pub(super) first: usize,
}

impl Transformed<'_> {
    /// Returns the address of the first cell, for writes of `cells` in each of the `planes` of every place.
    /// Also returns the number of values per plane.
    #[inline(always)]
    fn start(&mut self, planes: usize, cells: usize) -> (*mut f32, usize) {
        assert!(self.values.len() >= PLACES * planes * self.stride, "room for all planes");
        assert!(self.stride >= self.first + cells, "room for all cells");
        (self.values[self.first..].as_mut_ptr(), self.stride)
    }
}

/// Reader of the tiles of images.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reader<'a> {
    pub(super) source: Source<'a>,
    /// Number of values in half a row.
    half: usize,
    /// Number of rows of the inputs of a tile.
    rows: usize,
}

impl<'a> Reader<'a> {
    /// Creates a reader for the tiles of `tiles`.
    pub(super) fn new(source: Source<'a>, tiles: &Tiles) -> Self {
        // Vectors of a row of cells may reach past its end, and cells one column further.
        let half = tiles.columns.next_multiple_of(micro::lanes()) + 2;
        Self { source, half, rows: 2 * tiles.rows + 2 }
    }

    /// Returns the number of scratch values that a plane takes.
    pub(super) fn scratch(&self) -> usize {
        2 * self.half * (self.rows + 1)
    }

    /// Copies one row of a plane from column `left` on: first every second value from there, then those
    /// between. `line` is scratch memory for one row.
    #[inline(always)]
    fn split_row(
        &self,
        (values, mask): Row<'_>,
        row: usize,
        left: usize,
        line: &mut [f32],
        to: [&mut [f32]; 2],
    ) {
        let start = row * self.source.width + left;
        let count = (self.source.width - left).min(line.len());
        if mask.is_some() {
            copy((values, mask), start, 1, &mut line[..count]);
            split(&line[..count], to);
        } else {
            split(&values[start..start + count], to);
        }
    }

    /// Transforms the inputs of all planes of an image: `B^T d B`.
    #[inline(always)]
    pub(super) fn transform<S: Simd>(
        &self,
        simd: S,
        [image, planes]: [usize; 2],
        tile: Tile,
        scratch: &mut [f32],
        to: &mut Transformed<'_>,
    ) {
        let (to, stride) = to.start(planes, tile.cells() + S::F32_LANES);
        for number in 0..planes {
            self.fill(image, number, tile, scratch);
            for row in 0..tile.rows {
                for column in (0..tile.columns).step_by(S::F32_LANES) {
                    // SAFETY: a half row holds the vector after the last cell's, too; transformed inputs that
                    // reach past a row, or past the last one, are written anew or not looked at.
                    unsafe {
                        let from = scratch.as_ptr().add(4 * row * self.half + column);
                        let to = to.add(number * stride);
                        let to = to.add(row * tile.columns + column);
                        transform_cells(simd, from, self.half, to, planes * stride);
                    }
                }
            }
        }
    }

    /// Copies the inputs of plane `number`, one row after the other: the first and third columns of cells,
    /// then the second and fourth. Outside the image they are zero.
    #[inline(always)]
    fn fill(&self, image: usize, number: usize, tile: Tile, scratch: &mut [f32]) {
        let (scratch, line) = scratch[..self.scratch()].split_at_mut(2 * self.half * self.rows);
        let plane = self.source.plane(image, number);
        let left = 2 * tile.at[1];
        let rows = scratch.chunks_exact_mut(2 * self.half).enumerate();
        for (y, to) in rows.take(2 * tile.rows + 2) {
            let row = (2 * tile.at[0] + y).checked_sub(1).filter(|&row| row < self.source.height);
            let (Some(row), Some((values, mask))) = (row, plane) else {
                to.fill(0.0);
                continue;
            };
            let (before, after) = to.split_at_mut(self.half);
            let (first, before) = before.split_at_mut(1);
            let after = &mut after[..self.half - 1];
            self.split_row((values, mask), row, left, line, [after, before]);
            first[0] = 0.0;
            if left > 0 {
                copy((values, mask), row * self.source.width + left - 1, 1, first);
            }
        }
    }

    /// Transforms gradients of the results of all channels of an image: `A y A^T`. Adds the gradients of
    /// every channel to `sums`.
    #[inline(always)]
    pub(super) fn transform_gradients<S: Simd>(
        &self,
        simd: S,
        image: usize,
        tile: Tile,
        scratch: &mut [f32],
        to: &mut Transformed<'_>,
        sums: &mut [f32],
    ) {
        let channels = sums.len();
        let (to, stride) = to.start(channels, tile.cells() + S::F32_LANES);
        let (scratch, line) = scratch[..self.scratch()].split_at_mut(2 * self.half * self.rows);
        for (number, sum) in sums.iter_mut().enumerate() {
            let plane = self.source.plane(image, number);
            let rows = scratch.chunks_exact_mut(2 * self.half).enumerate();
            for (y, to) in rows.take(2 * tile.rows) {
                let row = 2 * tile.at[0] + y;
                let Some(plane) = plane.filter(|_| row < self.source.height) else {
                    to.fill(0.0);
                    continue;
                };
                let (even, odd) = to.split_at_mut(self.half);
                self.split_row(plane, row, 2 * tile.at[1], line, [&mut *even, &mut *odd]);
                *sum += even[..tile.columns].iter().chain(&odd[..tile.columns]).sum::<f32>();
            }
            for row in 0..tile.rows {
                for column in (0..tile.columns).step_by(S::F32_LANES) {
                    // SAFETY: as in `transform`.
                    unsafe {
                        let from = scratch.as_ptr().add(4 * row * self.half + column);
                        let to = to.add(number * stride);
                        let to = to.add(row * tile.columns + column);
                        transform_results(simd, from, self.half, to, channels * stride);
                    }
                }
            }
        }
    }
}

/// Copies the first of every two values to one slice, the second to the other, and zeros after the last. Both
/// are equally long.
#[inline(always)]
fn split(values: &[f32], [first, second]: [&mut [f32]; 2]) {
    let pairs = (values.len() / 2).min(first.len());
    let (firsts, last_first) = first[..pairs].as_chunks_mut::<RUN>();
    let (seconds, last_second) = second[..pairs].as_chunks_mut::<RUN>();
    let (runs, last) = values[..2 * pairs].as_chunks::<{ 2 * RUN }>();
    for ((first, second), run) in firsts.iter_mut().zip(seconds).zip(runs) {
        // Copies of known length become shuffles.
        let run = *run;
        let mut halves = [[0.0; RUN]; 2];
        for i in 0..RUN {
            halves[0][i] = run[2 * i];
        }
        for i in 0..RUN {
            halves[1][i] = run[2 * i + 1];
        }
        [*first, *second] = halves;
    }
    let last = last.chunks_exact(2);
    for ((first, second), pair) in last_first.iter_mut().zip(last_second).zip(last) {
        (*first, *second) = (pair[0], pair[1]);
    }
    first[pairs..].fill(0.0);
    second[pairs..].fill(0.0);
    if let (Some(first), Some(&last)) = (first.get_mut(pairs), values.get(2 * pairs)) {
        *first = last;
    }
}

/// Transforms the inputs of a vector of cells and writes the sums of every place, `step` values apart. Rows
/// of inputs are twice `half` values long: the first and third columns of cells, then the second and fourth.
///
/// # Safety
/// `from` must be valid for reads of four rows of both halves with one vector and a value each, and `to` for
/// writes of a vector at every place.
#[inline(always)]
unsafe fn transform_cells<S: Simd>(
    simd: S,
    from: *const f32,
    half: usize,
    to: *mut f32,
    step: usize,
) {
    let mut sums = [[simd.splat_f32s(0.0); 4]; 4];
    for y in 0..4 {
        let mut values = sums[y];
        for x in 0..4 {
            // SAFETY: the caller's promise.
            values[x] = unsafe { read::<S>(from.add((2 * y + x % 2) * half + x / 2)) };
        }
        sums[y] = four_of_inputs(simd, values);
    }
    for x in 0..4 {
        let column = [sums[0][x], sums[1][x], sums[2][x], sums[3][x]];
        // SAFETY: the caller's promise.
        unsafe { write_column::<S>(four_of_inputs(simd, column), to.add(x * step), 4 * step) };
    }
}

/// Transforms the gradients of a vector of cells and writes the sums of every place, `step` values apart.
/// Rows are twice `half` values long: the first columns of cells, then the second.
///
/// # Safety
/// `from` must be valid for reads of a vector in two rows of both halves, and `to` for writes of a vector at
/// every place.
#[inline(always)]
unsafe fn transform_results<S: Simd>(
    simd: S,
    from: *const f32,
    half: usize,
    to: *mut f32,
    step: usize,
) {
    let mut sums = [[simd.splat_f32s(0.0); 4]; 2];
    for y in 0..2 {
        // SAFETY: the caller's promise.
        let [first, second] =
            unsafe { [read::<S>(from.add(2 * y * half)), read::<S>(from.add((2 * y + 1) * half))] };
        sums[y] = four_of_results(simd, first, second);
    }
    for x in 0..4 {
        let column = four_of_results(simd, sums[0][x], sums[1][x]);
        // SAFETY: the caller's promise.
        unsafe { write_column::<S>(column, to.add(x * step), 4 * step) };
    }
}

/// Computes `B^T d`.
#[inline(always)]
fn four_of_inputs<S: Simd>(simd: S, [a, b, c, d]: [S::f32s; 4]) -> [S::f32s; 4] {
    [simd.sub_f32s(a, c), simd.add_f32s(b, c), simd.sub_f32s(c, b), simd.sub_f32s(b, d)]
}

/// Computes `A y`.
#[inline(always)]
fn four_of_results<S: Simd>(simd: S, a: S::f32s, b: S::f32s) -> [S::f32s; 4] {
    [a, simd.add_f32s(a, b), simd.sub_f32s(a, b), simd.neg_f32s(b)]
}

/// Reads a vector.
///
/// # Safety
/// `from` must be valid for reads of a vector.
#[inline(always)]
pub(super) unsafe fn read<S: Simd>(from: *const f32) -> S::f32s {
    // SAFETY: the caller's promise.
    unsafe { from.cast::<S::f32s>().read_unaligned() }
}

/// Writes vectors, `step` values apart.
///
/// # Safety
/// `to` must be valid for writes of every vector.
#[inline(always)]
unsafe fn write_column<S: Simd>(column: [S::f32s; 4], to: *mut f32, step: usize) {
    for y in 0..4 {
        // SAFETY: the caller's promise.
        unsafe { to.add(y * step).cast::<S::f32s>().write_unaligned(column[y]) };
    }
}
