//! Patches that cover an image.

use crate::patch::{Patch, SIDE};
use multiversion::multiversion;
use qudi_core::{Frame, Size};

/// Corners of square patches, the last ones at the borders.
#[derive(Clone, Debug)]
pub(crate) struct Grid {
    pub(crate) side: usize,
    pub(crate) xs: Vec<usize>,
    pub(crate) ys: Vec<usize>,
}

impl Grid {
    /// Patches of `side` pixels, `step` apart, on an image at least that large.
    pub(crate) fn new(size: Size, side: usize, step: usize) -> Self {
        let corners = |length: usize| {
            let last = length.saturating_sub(side);
            (0..last).step_by(step).chain([last]).collect()
        };
        Self { side, xs: corners(size.width), ys: corners(size.height) }
    }

    /// Lays out the patches of alignment and merging: each overlaps the next by half (Ma et al. 2020, section
    /// 5.1).
    pub(crate) fn half_overlapping(size: Size) -> Self {
        Self::new(size, SIDE, SIDE / 2)
    }

    /// The number of patches.
    pub(crate) fn len(&self) -> usize {
        self.xs.len() * self.ys.len()
    }

    /// Corner of patch `i`.
    pub(crate) fn corner(&self, i: usize) -> [usize; 2] {
        [self.xs[i % self.xs.len()], self.ys[i / self.xs.len()]]
    }

    /// The upper left part, of size `to`, of a frame of size `from` that overlapping patches make, each of
    /// which fades out towards its borders.
    pub(crate) fn blended(&self, from: Size, to: Size, patch: impl Fn(usize) -> Patch) -> Frame {
        let mut sum = Frame::filled(from, 0.0);
        let mut weights = sum.clone();
        let window: [f32; SIDE] = std::array::from_fn(|k| {
            0.5 - 0.5 * (2.0 * std::f32::consts::PI * (k as f32 + 0.5) / SIDE as f32).cos()
        });
        for i in 0..self.len() {
            let [x, y] = self.corner(i);
            let at = y * from.width + x;
            add_weighted(
                &patch(i),
                &window,
                from.width,
                [&mut sum.data[at..], &mut weights.data[at..]],
            );
        }
        Frame::from_fn(to, |x, y| sum.row(y)[x] / weights.row(y)[x])
    }

    /// The patch whose centre is nearest to `point`, and its neighbours left, right, above and below.
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

    /// The 3 x 3 patches around patch `i` and itself, as far as there are so many.
    pub(crate) fn touching(&self, i: usize) -> impl Iterator<Item = usize> + use<> {
        let (columns, rows) = (self.xs.len(), self.ys.len());
        let (x, y) = (i % columns, i / columns);
        (y.saturating_sub(1)..(y + 2).min(rows)).flat_map(move |row| {
            (x.saturating_sub(1)..(x + 2).min(columns)).map(move |column| row * columns + column)
        })
    }

    /// Medians of both components over the 3 x 3 patches around patch `i`.
    pub(crate) fn median_around(&self, flow: &[[f32; 2]], i: usize) -> [f32; 2] {
        let mut near = [[0.0f32; 9]; 2];
        let mut n = 0;
        for patch in self.touching(i) {
            for k in 0..2 {
                near[k][n] = flow[patch][k];
            }
            n += 1;
        }
        near.map(|mut values| {
            if n == values.len() {
                return median_of_nine(values);
            }
            values[..n].sort_unstable_by(f32::total_cmp);
            0.5 * (values[(n - 1) / 2] + values[n / 2])
        })
    }
}

/// Adds a patch times its window, and the window, to the rows of an image from the patch's corner on.
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

/// The median, by exchanges that need no branches (Smith, "Implementing median
/// filters in XC4000E FPGAs", XCELL 23, 1996).
fn median_of_nine(mut v: [f32; 9]) -> f32 {
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
    for [a, b] in EXCHANGES {
        (v[a], v[b]) = (v[a].min(v[b]), v[a].max(v[b]));
    }
    v[4]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_are_the_middle_of_sorted_values() {
        for seed in 0..500u32 {
            let values: [f32; 9] = std::array::from_fn(|i| {
                let mixed = (seed * 9 + i as u32 + 1).wrapping_mul(2_654_435_761) >> 24;
                (mixed % 16) as f32 - 8.0
            });
            let mut sorted = values;
            sorted.sort_unstable_by(f32::total_cmp);
            assert_eq!(median_of_nine(values), sorted[4], "{values:?}");
        }
    }
}
