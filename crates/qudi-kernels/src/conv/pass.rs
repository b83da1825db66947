//! A pass: one correlation over a grid, with its taps and the layout of its input tiles in scratch memory.
//!
//! A convolution of stride 1 or 2 is one pass. The input gradient of a convolution of stride 2 is four
//! passes, one for each parity of row and column, so that nothing is multiplied by zero.

use super::geometry::Geometry;
use super::scratch::Format;

/// Maximum number of scratch values per tile: a quarter of a megabyte, which stays in a core's second-level
/// cache.
const SCRATCH_VALUES: usize = 64 * 1024;

/// Minimum number of pixels in a tile that is worth the copy of its borders.
const TILE_PIXELS: usize = 2048;

/// Taps that read one plane, and the grid of results.
#[derive(Clone, Debug)]
pub(super) struct Pass {
    /// Rows and columns of the taps relative to the first one, in the order of the weights.
    pub(super) taps: Vec<[usize; 2]>,
    /// Input row and column of the first tap of the first result; may lie outside the image.
    pub(super) first: [isize; 2],
    /// Input rows and columns between neighbouring results.
    pub(super) stride: usize,
    /// Rows and columns of results.
    pub(super) grid: [usize; 2],
    /// Row and column where the first result is written.
    pub(super) place: [usize; 2],
    /// Step between neighbouring results where they are written.
    pub(super) step: usize,
}

/// Sizes of a pass's tiles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tiling {
    /// Rows of results in a tile.
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// Number of tiles down the image.
    pub(super) down: usize,
    pub(super) across: usize,
    /// Input rows of a tile.
    pub(super) input_rows: usize,
    /// Scratch values per input row.
    pub(super) row: usize,
    pub(super) half: usize,
    /// Number of scratch planes that fit into scratch memory at once.
    pub(super) planes: usize,
    /// Format of scratch memory.
    pub(super) format: Format,
}

impl Pass {
    /// Creates the pass of the convolution itself.
    pub(super) fn forward(geometry: &Geometry) -> Self {
        let [_, rows, columns] = geometry.kernel;
        let taps = (0..rows).flat_map(|y| (0..columns).map(move |x| [y, x])).collect();
        let first = [-((rows / 2) as isize), -((columns / 2) as isize)];
        let grid = geometry.output_grid();
        Self { taps, first, stride: geometry.stride, grid, place: [0, 0], step: 1 }
    }

    /// Creates the pass of the input gradient for rows and columns of one parity. Also returns the row and
    /// column in the kernel of every tap. Returns `None` if there are no such rows or columns; the pass has
    /// no taps if no result depends on them.
    pub(super) fn backward(
        geometry: &Geometry,
        parity: [usize; 2],
    ) -> Option<(Self, Vec<[usize; 2]>)> {
        let stride = geometry.stride;
        let size = [geometry.height, geometry.width];
        let mut axes = Vec::new();
        for axis in 0..2 {
            let kernel = geometry.kernel[axis + 1];
            // Input position i = stride * o + k - kernel / 2, for result o and kernel position k.
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

    /// Chooses tiles whose input fits the second-level cache. They do not depend on the number of threads, so
    /// that sums over tiles do not either. `planes` is the number of scratch planes, `run` the longest run of
    /// pixels of a block.
    pub(super) fn tiling(&self, format: Format, planes: usize, run: usize) -> Tiling {
        let [grid_rows, grid_columns] = self.grid;
        let group = format.group();
        // One long row is cut so that all planes fit at once; partial sums would go through memory.
        let widest = if grid_rows == 1 {
            (SCRATCH_VALUES / planes).clamp(4 * run, TILE_PIXELS)
        } else {
            8 * run
        };
        let across = grid_columns.div_ceil(widest);
        let columns = grid_columns.div_ceil(across);
        let reach = |axis: usize| self.taps.iter().map(|tap| tap[axis]).max().unwrap_or(0);
        // Blocks read whole runs: the row is long enough for the tile's last run.
        let span = columns.next_multiple_of(run);
        let half = span + reach(1) / 2 + 1;
        let row = if self.stride == 1 { span + reach(1) } else { 2 * half };
        let input_rows = |rows: usize| self.stride * (rows - 1) + 1 + reach(0);
        let mut rows = (TILE_PIXELS / columns).clamp(1, grid_rows);
        while rows > 4 && planes * input_rows(rows) * row > SCRATCH_VALUES {
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
            planes: (SCRATCH_VALUES / plane / group * group).clamp(group, planes),
            format,
        }
    }
}

impl Tiling {
    /// Returns the number of tiles per image.
    pub(super) fn count(&self) -> usize {
        self.down * self.across
    }

    /// Returns the number of scratch values per plane.
    pub(super) fn plane(&self) -> usize {
        self.input_rows * self.row
    }

    /// Returns the first result of tile `number`, and its size.
    pub(super) fn tile(&self, number: usize, grid: [usize; 2]) -> ([usize; 2], [usize; 2]) {
        let at = [number / self.across * self.rows, number % self.across * self.columns];
        let size = [self.rows.min(grid[0] - at[0]), self.columns.min(grid[1] - at[1])];
        (at, size)
    }

    /// Returns the number of scratch values per tile.
    pub(super) fn scratch(&self) -> usize {
        self.planes * self.plane()
    }

    /// Returns the scratch offsets of the taps of `planes` scratch planes or groups of planes, in the order
    /// of the weights.
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
