//! Convolutions with 3 x 3 taps in fewer products: Winograd's minimal filtering F(2 x 2, 3 x 3) (Lavin and
//! Gray 2016, section 4.1).
//!
//! A cell is 2 x 2 results. Its 4 x 4 inputs become 16 sums of them, the 3 x 3 weights 16 sums of theirs, and
//! the products of both, summed over the input planes, become the 2 x 2 results: 16 products instead of 36.
//! The gradient of the weights goes the same way back. Results differ from direct sums by rounding only.

mod inputs;
mod run;
mod weight_gradient;

pub(super) use run::{Packed, run};
pub(super) use weight_gradient::weight_gradient;

use super::pass::Pass;
use super::scratch::Format;

/// Number of products for a cell, in four rows of four.
const PLACES: usize = 16;

/// Minimum number of planes and of outputs that is worth the transforms.
const MIN_CHANNELS: usize = 16;

/// Returns true if a pass has fewer products this way, and pays for the transforms.
pub(super) fn serves(pass: &Pass, format: Format, planes: usize, outputs: usize) -> bool {
    let square = (0..9).map(|tap| [tap / 3, tap % 3]);
    format == Format::Single
        && pass.stride == 1
        && pass.step == 1
        && pass.taps.iter().copied().eq(square)
        && planes.min(outputs) >= MIN_CHANNELS
}

/// Tiles of cells.
#[derive(Clone, Copy, Debug)]
struct Tiles {
    /// Cells down and across an image.
    grid: [usize; 2],
    /// Cells down and across a tile.
    rows: usize,
    columns: usize,
}

impl Tiles {
    /// Cuts a grid of results into tiles of at most `most` cells, of about the same size.
    fn new(grid: [usize; 2], most: usize) -> Self {
        let grid = grid.map(|size| size.div_ceil(2));
        let columns = grid[1].div_ceil(grid[1].div_ceil(most));
        let rows = grid[0].div_ceil(grid[0].div_ceil((most / columns).max(1)));
        Self { grid, rows, columns }
    }

    /// Returns the number of tiles per image.
    fn count(&self) -> usize {
        self.grid[0].div_ceil(self.rows) * self.grid[1].div_ceil(self.columns)
    }

    /// Returns tile `number`.
    fn tile(&self, number: usize) -> Tile {
        let across = self.grid[1].div_ceil(self.columns);
        let at = [number / across * self.rows, number % across * self.columns];
        Tile {
            at,
            rows: self.rows.min(self.grid[0] - at[0]),
            columns: self.columns.min(self.grid[1] - at[1]),
        }
    }

    /// Returns the number of cells in the largest tile.
    fn cells(&self) -> usize {
        self.rows * self.columns
    }
}

/// A tile of cells.
#[derive(Clone, Copy, Debug)]
struct Tile {
    /// Row and column of the first cell.
    at: [usize; 2],
    /// Cells down and across.
    rows: usize,
    columns: usize,
}

impl Tile {
    /// Returns the number of cells.
    fn cells(&self) -> usize {
        self.rows * self.columns
    }
}
