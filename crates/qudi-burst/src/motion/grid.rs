//! Grid of patches that cover an image.

use crate::patch::{Patch, SIDE};
use multiversion::multiversion;
use qudi_core::{Frame, Size};
use std::borrow::Borrow;

/// Corners of square patches, the last ones at the image's borders.
#[derive(Clone, Debug)]
pub(crate) struct Grid {
    pub(crate) side: usize,
    pub(crate) xs: Vec<usize>,
    pub(crate) ys: Vec<usize>,
}

impl Grid {
    /// Creates a grid of patches of `side` pixels, `step` apart, on an image at least that large.
    pub(crate) fn new(size: Size, side: usize, step: usize) -> Self {
        let corners = |length: usize| {
            let last = length.saturating_sub(side);
            (0..last).step_by(step).chain([last]).collect()
        };
        Self { side, xs: corners(size.width), ys: corners(size.height) }
    }

    /// Creates the grid of alignment and merging: each patch overlaps the next by half (Ma et al. 2020,
    /// section 5.1).
    pub(crate) fn half_overlapping(size: Size) -> Self {
        Self::new(size, SIDE, SIDE / 2)
    }

    /// Returns the number of patches.
    pub(crate) fn len(&self) -> usize {
        self.xs.len() * self.ys.len()
    }

    /// Returns the corner of patch `i`.
    pub(crate) fn corner(&self, i: usize) -> [usize; 2] {
        [self.xs[i % self.xs.len()], self.ys[i / self.xs.len()]]
    }

    /// Blends overlapping patches, faded out towards their borders, into a frame of size `from`, and crops it
    /// to size `to`.
    pub(crate) fn blended<P: Borrow<Patch>>(
        &self,
        from: Size,
        to: Size,
        patch: impl Fn(usize) -> P,
    ) -> Frame {
        let mut sum = Frame::filled(from, 0.0);
        let mut weights = sum.clone();
        let window: [f32; SIDE] = std::array::from_fn(fading);
        for i in 0..self.len() {
            let [x, y] = self.corner(i);
            let at = y * from.width + x;
            add_weighted(
                patch(i).borrow(),
                &window,
                from.width,
                [&mut sum.data[at..], &mut weights.data[at..]],
            );
        }
        let mut data = Vec::with_capacity(to.pixels());
        for y in 0..to.height {
            let pixels = sum.row(y)[..to.width].iter().zip(weights.row(y));
            data.extend(pixels.map(|(sum, weight)| sum / weight));
        }
        Frame { size: to, data }
    }

    /// Returns the patch whose centre is nearest to `point`, and its neighbours left, right, above and below.
    pub(crate) fn around(&self, point: [f32; 2]) -> [usize; 5] {
        let nearest = |corners: &[usize], at: f32| {
            let corner = at - 0.5 * self.side as f32;
            let above = corners.partition_point(|&c| (c as f32) < corner).min(corners.len() - 1);
            let below = above.saturating_sub(1);
            let distance = |i: usize| (corners[i] as f32 - corner).abs();
            if distance(below) < distance(above) { below } else { above }
        };
        let (x, y) = (nearest(&self.xs, point[0]), nearest(&self.ys, point[1]));
        let columns = self.xs.len();
        let right = (x + 1).min(columns - 1);
        let below = (y + 1).min(self.ys.len() - 1);
        [
            y * columns + x,
            y * columns + x.saturating_sub(1),
            y * columns + right,
            y.saturating_sub(1) * columns + x,
            below * columns + x,
        ]
    }

    /// Returns the 3 x 3 patches around patch `i` including itself, without patches outside the grid.
    pub(crate) fn touching(&self, i: usize) -> impl Iterator<Item = usize> + use<> {
        let (columns, rows) = (self.xs.len(), self.ys.len());
        let (x, y) = (i % columns, i / columns);
        (y.saturating_sub(1)..(y + 2).min(rows)).flat_map(move |row| {
            (x.saturating_sub(1)..(x + 2).min(columns)).map(move |column| row * columns + column)
        })
    }

    /// Computes the medians of both components over the 3 x 3 patches around every patch.
    pub(crate) fn medians(&self, flow: &[[f32; 2]]) -> Vec<[f32; 2]> {
        let (columns, rows) = (self.xs.len(), self.ys.len());
        let mut medians = vec![[0.0; 2]; flow.len()];
        for y in 0..rows {
            let inner = y > 0 && y + 1 < rows && columns > 2;
            if inner {
                let row = |y: usize| flow[y * columns..][..columns].as_flattened();
                let out = &mut medians[y * columns..][1..columns - 1];
                medians_of_nine([y - 1, y, y + 1].map(row), out.as_flattened_mut());
            }
            let border = if inner { columns - 1 } else { 1 };
            for i in (0..columns).step_by(border).map(|x| y * columns + x) {
                medians[i] = self.median_at_border(flow, i);
            }
        }
        medians
    }

    /// Computes the medians at the border, where fewer patches surround patch `i`.
    fn median_at_border(&self, flow: &[[f32; 2]], i: usize) -> [f32; 2] {
        [0, 1].map(|component| {
            let mut near: Vec<f32> = self.touching(i).map(|patch| flow[patch][component]).collect();
            near.sort_unstable_by(f32::total_cmp);
            0.5 * (near[(near.len() - 1) / 2] + near[near.len() / 2])
        })
    }
}

/// Returns the weight of a patch along an axis, `at` pixels from its corner: it fades out towards both ends.
pub(crate) fn fading(at: usize) -> f32 {
    0.5 - 0.5 * (2.0 * std::f32::consts::PI * (at as f32 + 0.5) / SIDE as f32).cos()
}

/// Adds a patch times its window, and the window, to the rows of an image, starting at the patch's corner.
#[multiversion(targets("x86_64+avx2"))]
fn add_weighted(
    patch: &Patch,
    window: &[f32; SIDE],
    width: usize,
    [sum, weights]: [&mut [f32]; 2],
) {
    for (r, row) in patch.iter().enumerate() {
        let place = r * width..r * width + SIDE;
        let (sum, weights) = (&mut sum[place.clone()], &mut weights[place]);
        for c in 0..SIDE {
            let weight = window[r] * window[c];
            sum[c] += weight * row[c];
            weights[c] += weight;
        }
    }
}

/// Computes medians of 3 x 3 values, two columns apart, from three rows. `out` is two columns shorter on each
/// side. It uses a branch-free exchange network (Smith, "Implementing median filters in XC4000E FPGAs", XCELL
/// 23, 1996).
#[multiversion(targets("x86_64+avx2"))]
fn medians_of_nine(rows: [&[f32]; 3], out: &mut [f32]) {
    const LANES: usize = 8;
    const EXCHANGES: [[usize; 2]; 19] = [
        [1, 2],
        [4, 5],
        [7, 8],
        [0, 1],
        [3, 4],
        [6, 7],
        [1, 2],
        [4, 5],
        [7, 8],
        [0, 3],
        [5, 8],
        [4, 7],
        [3, 6],
        [1, 4],
        [2, 5],
        [4, 7],
        [4, 2],
        [6, 4],
        [4, 2],
    ];
    for (chunk, out) in out.chunks_mut(LANES).enumerate() {
        let first = chunk * LANES;
        let mut v = [[0.0f32; LANES]; 9];
        for (k, v) in v.iter_mut().enumerate() {
            let from = &rows[k / 3][first + 2 * (k % 3)..];
            v[..out.len()].copy_from_slice(&from[..out.len()]);
        }
        for [a, b] in EXCHANGES {
            for lane in 0..LANES {
                let (low, high) = (v[a][lane].min(v[b][lane]), v[a][lane].max(v[b][lane]));
                v[a][lane] = low;
                v[b][lane] = high;
            }
        }
        out.copy_from_slice(&v[4][..out.len()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares medians with sorted values inside the grid and at its borders, down to the narrowest grids.
    #[test]
    fn medians_are_the_middle_of_sorted_values() {
        for (width, height) in [(16, 16), (24, 16), (32, 24), (120, 88), (168, 24)] {
            let grid = Grid::half_overlapping(Size { height, width });
            let value = |i: usize| {
                let mixed = (i as u32 + 1).wrapping_mul(2_654_435_761) >> 24;
                (mixed % 16) as f32 - 8.0
            };
            let flow: Vec<[f32; 2]> =
                (0..grid.len()).map(|i| [value(2 * i), value(2 * i + 1)]).collect();
            for (i, median) in grid.medians(&flow).iter().enumerate() {
                for component in 0..2 {
                    let mut near: Vec<f32> =
                        grid.touching(i).map(|patch| flow[patch][component]).collect();
                    near.sort_unstable_by(f32::total_cmp);
                    let middle = 0.5 * (near[(near.len() - 1) / 2] + near[near.len() / 2]);
                    assert_eq!(median[component], middle, "patch {i} of {width} x {height}");
                }
            }
        }
    }
}
