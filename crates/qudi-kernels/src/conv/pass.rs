//! One correlation over a grid: which taps it has, and how a tile of its input lies in scratch memory.
//!
//! A convolution of stride 1 or 2 is one pass. The gradient for the input of a convolution of stride 2
//! is four, one for each parity of row and column, so that no multiplication with a zero is done.

use super::geometry::Geometry;
use super::scratch::Format;

/// Values of scratch that one tile may use: a quarter of a megabyte stays in a core's second-level cache.
const SCRATCH: usize = 64 * 1024;

/// Pixels of a tile that are worth the copy of its borders.
const TILE: usize = 2048;

/// Taps that read one plane, and the grid of results.
#[derive(Clone, Debug)]
pub(super) struct Pass {
    /// Rows and columns of the taps from the first one, in the order of the weights.
    pub(super) taps: Vec<[usize; 2]>,
    /// Input row and column of the first tap of the first result; may lie outside.
    pub(super) first: [isize; 2],
    /// Input rows and columns from one result to the next.
    pub(super) stride: usize,
    /// Results: rows, columns.
    pub(super) grid: [usize; 2],
    /// Where results go: row and column of the first, and the step from one to the next.
    pub(super) place: [usize; 2],
    pub(super) step: usize,
}

/// Sizes of a pass's tiles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tiling {
    /// Results of a tile: rows, columns.
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// Tiles down and across.
    pub(super) down: usize,
    pub(super) across: usize,
    /// Input rows of a tile.
    pub(super) input_rows: usize,
    /// Scratch values of an input row, and of one column parity where the stride is 2.
    pub(super) row: usize,
    pub(super) half: usize,
    /// Scratch planes that fit into scratch at once.
    pub(super) planes: usize,
    /// What a place of scratch holds.
    pub(super) format: Format,
}

impl Pass {
    /// The convolution itself.
    pub(super) fn forward(geometry: &Geometry) -> Self {
        let [_, rows, columns] = geometry.kernel;
        let taps = (0..rows).flat_map(|y| (0..columns).map(move |x| [y, x])).collect();
        let first = [-((rows / 2) as isize), -((columns / 2) as isize)];
        let grid = geometry.output_grid();
        Self { taps, first, stride: geometry.stride, grid, place: [0, 0], step: 1 }
    }

    /// The gradient for the input rows and columns of one parity, and the number of the kernel's row and
    /// column behind every tap. Nothing where there are no such rows or columns; a pass without taps where
    /// no result depends on them.
    pub(super) fn backward(
        geometry: &Geometry,
        parity: [usize; 2],
    ) -> Option<(Self, Vec<[usize; 2]>)> {
        let stride = geometry.stride;
        let size = [geometry.height, geometry.width];
        let mut axes = Vec::new();
        for axis in 0..2 {
            let kernel = geometry.kernel[axis + 1];
            // Input place i = stride * o + k - kernel / 2, for the result o and the kernel's place k.
            let start = (parity[axis] + kernel / 2) % stride;
            let places: Vec<usize> = (start..kernel).step_by(stride).collect();
            let last = places.last().copied().unwrap_or(start);
            let first = (parity[axis] + kernel / 2) as isize - last as isize;
            axes.push((places, first / stride as isize));
            if size[axis] <= parity[axis] {
                return None;
            }
        }
        let count = |axis: usize| (size[axis] - parity[axis]).div_ceil(stride);
        let mut taps = Vec::new();
        let mut kernel = Vec::new();
        for (j, &y) in axes[0].0.iter().rev().enumerate() {
            for (i, &x) in axes[1].0.iter().rev().enumerate() {
                taps.push([j, i]);
                kernel.push([y, x]);
            }
        }
        let pass = Self {
            taps,
            first: [axes[0].1, axes[1].1],
            stride: 1,
            grid: [count(0), count(1)],
            place: parity,
            step: stride,
        };
        Some((pass, kernel))
    }

    /// Tiles whose input fits the second-level cache. Does not depend on the number of threads: sums
    /// over tiles come out the same with any number. `planes` are scratch planes, `run` is the longest run of
    /// pixels of a block.
    pub(super) fn tiling(&self, format: Format, planes: usize, run: usize) -> Tiling {
        let [grid_rows, grid_columns] = self.grid;
        let group = format.group();
        // One long row is cut so that all planes fit at once; sums of parts would go through memory.
        let widest = if grid_rows == 1 { (SCRATCH / planes).clamp(4 * run, TILE) } else { 8 * run };
        let across = grid_columns.div_ceil(widest);
        let columns = grid_columns.div_ceil(across);
        let reach = |axis: usize| self.taps.iter().map(|tap| tap[axis]).max().unwrap_or(0);
        // Blocks read whole runs: the row is as long as if the tile's last run were full.
        let span = columns.next_multiple_of(run);
        let half = span + reach(1) / 2 + 1;
        let row = if self.stride == 1 { span + reach(1) } else { 2 * half };
        let input_rows = |rows: usize| self.stride * (rows - 1) + 1 + reach(0);
        let mut rows = (TILE / columns).clamp(1, grid_rows);
        while rows > 4 && planes * input_rows(rows) * row > SCRATCH {
            rows = rows.div_ceil(2);
        }
        let plane = input_rows(rows) * row;
        Tiling {
            rows,
            columns,
            down: grid_rows.div_ceil(rows),
            across,
            input_rows: input_rows(rows),
            row,
            half,
            planes: (SCRATCH / plane / group * group).clamp(group, planes),
            format,
        }
    }
}

impl Tiling {
    /// Tiles of one image.
    pub(super) fn count(&self) -> usize {
        self.down * self.across
    }

    /// Scratch values of one plane.
    pub(super) fn plane(&self) -> usize {
        self.input_rows * self.row
    }

    /// First result of tile `number`, and its size.
    pub(super) fn tile(&self, number: usize, grid: [usize; 2]) -> ([usize; 2], [usize; 2]) {
        let at = [number / self.across * self.rows, number % self.across * self.columns];
        let size = [self.rows.min(grid[0] - at[0]), self.columns.min(grid[1] - at[1])];
        (at, size)
    }

    /// Scratch values of a tile.
    pub(super) fn scratch(&self) -> usize {
        self.planes * self.plane()
    }

    /// Scratch offsets of the taps of `planes` scratch planes, or of their groups, in the order of the weights.
    pub(super) fn offsets(&self, pass: &Pass, planes: usize) -> Vec<u32> {
        let mut offsets = Vec::with_capacity(planes * pass.taps.len());
        for plane in (0..planes).step_by(self.format.group()) {
            for &[y, x] in &pass.taps {
                let column = if pass.stride == 1 { x } else { x % 2 * self.half + x / 2 };
                offsets.push((plane * self.plane() + y * self.row + column) as u32);
            }
        }
        offsets
    }
}
