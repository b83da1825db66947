//! Motion of overlapping patches, blended on a grid of cells.

use super::grid::{Grid, fading};
use crate::patch::SIDE;
use qudi_core::{Frame, Size};

/// Weights of the patches of a grid in every cell of `side` x `side` pixels.
///
/// Patches fade out towards their borders, along rows and columns alike, so that the weights along both axes
/// multiply.
#[derive(Debug)]
pub(crate) struct Cells {
    columns: Vec<Vec<(usize, f32)>>,
    rows: Vec<Vec<(usize, f32)>>,
    /// Patches of a row of the grid.
    patches: usize,
}

impl Cells {
    /// Prepares the weights on an image of `size`, of which cells that are not whole are left out.
    pub(crate) fn new(grid: &Grid, size: Size, side: usize) -> Self {
        Self {
            columns: weights(&grid.xs, size.width, side),
            rows: weights(&grid.ys, size.height, side),
            patches: grid.xs.len(),
        }
    }

    /// Blends a vector of every patch; one plane for each of its components.
    pub(crate) fn blended(&self, patches: &[[f32; 2]]) -> [Frame; 2] {
        let size = Size { height: self.rows.len(), width: self.columns.len() };
        let along_rows: Vec<Vec<[f32; 2]>> = patches
            .chunks_exact(self.patches)
            .map(|row| self.columns.iter().map(|weights| sum(weights, |i| row[i])).collect())
            .collect();
        let mut planes = [0, 1].map(|_| Frame::filled(size, 0.0));
        for (y, weights) in self.rows.iter().enumerate() {
            for x in 0..size.width {
                let vector = sum(weights, |i| along_rows[i][x]);
                for (plane, value) in planes.iter_mut().zip(vector) {
                    plane.data[y * size.width + x] = value;
                }
            }
        }
        planes
    }
}

/// Returns the patches of every cell along an axis with their weights, which sum to one.
fn weights(corners: &[usize], length: usize, side: usize) -> Vec<Vec<(usize, f32)>> {
    let of_pixel = |at: usize| -> Vec<(usize, f32)> {
        let over = corners
            .iter()
            .enumerate()
            .filter(|(_, corner)| (**corner..**corner + SIDE).contains(&at));
        let weights: Vec<(usize, f32)> = over.map(|(i, corner)| (i, fading(at - corner))).collect();
        let total: f32 = weights.iter().map(|(_, weight)| weight).sum();
        weights.into_iter().map(|(i, weight)| (i, weight / total)).collect()
    };
    let of_cell = |cell: usize| {
        let mut list: Vec<(usize, f32)> = Vec::new();
        for (patch, weight) in (cell * side..(cell + 1) * side).flat_map(of_pixel) {
            let weight = weight / side as f32;
            match list.iter_mut().find(|(known, _)| *known == patch) {
                Some((_, sum)) => *sum += weight,
                None => list.push((patch, weight)),
            }
        }
        list
    };
    (0..length / side).map(of_cell).collect()
}

fn sum(weights: &[(usize, f32)], value: impl Fn(usize) -> [f32; 2]) -> [f32; 2] {
    weights.iter().fold([0.0; 2], |sum, (i, weight)| {
        let value = value(*i);
        [sum[0] + weight * value[0], sum[1] + weight * value[1]]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells hold the means of what blending gives every pixel.
    #[test]
    fn cells_are_means_of_blended_pixels() {
        for (height, width) in [(16, 16), (40, 56), (43, 30)] {
            let size = Size { height, width };
            let grid = Grid::half_overlapping(size);
            let patches: Vec<[f32; 2]> = (0..grid.len())
                .map(|i| [(i as f32 * 1.7).sin(), (i as f32 * 0.6).cos() * 3.0])
                .collect();
            for side in [1, 2] {
                let cells = Cells::new(&grid, size, side).blended(&patches);
                for axis in [0, 1] {
                    let pixels = grid.blended(size, size, |i| [[patches[i][axis]; SIDE]; SIDE]);
                    let expected = Frame::from_fn(cells[axis].size, |x, y| {
                        let rows = y * side..(y + 1) * side;
                        let row = |y: usize| &pixels.row(y)[x * side..(x + 1) * side];
                        rows.flat_map(row).sum::<f32>() / (side * side) as f32
                    });
                    for (got, expected) in cells[axis].data.iter().zip(&expected.data) {
                        assert!(
                            (got - expected).abs() < 1e-5,
                            "{height} x {width}: {got} {expected}"
                        );
                    }
                }
            }
        }
    }
}
