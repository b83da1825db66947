//! Block matching: finds the blocks most similar to each reference block of a row.
//!
//! All reference blocks of a row are compared with their neighbours at one displacement at a time. Squared
//! differences are summed down the columns of the eight rows once, and a block's sum adds eight neighbouring
//! columns. This takes a third of the work of comparing block by block, and runs along rows.

use super::block::BLOCK;
use multiversion::multiversion;
use qudi_core::Size;

/// Search region and similarity criterion of block matching.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Search {
    /// Step between reference blocks, in pixels.
    pub(crate) step: usize,
    /// Maximum displacement in x and in y, in pixels.
    pub(crate) radius: usize,
    /// Maximum number of blocks in a group, including the reference block.
    pub(crate) max_blocks: usize,
    /// Upper bound of the mean squared difference of similar blocks.
    pub(crate) threshold: f32,
}

/// A block similar to the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Match {
    /// Sum of squared differences.
    pub(crate) distance: f32,
    /// Offset of the block's corner in the image.
    pub(crate) at: u32,
}

/// Matcher that finds groups row by row and reuses its buffers.
#[derive(Debug, Default)]
pub(crate) struct Matcher {
    columns: Vec<f32>,
    pairs: Vec<f32>,
    fours: Vec<f32>,
    /// Largest distance that still enters each group.
    bounds: Vec<f32>,
    groups: Vec<Vec<Match>>,
}

impl Matcher {
    /// Returns the groups of the reference blocks with corners at row `y` and columns `xs` (ascending). Each
    /// group is sorted by distance, and the reference block comes first.
    pub(crate) fn groups(
        &mut self,
        image: &[f32],
        size: Size,
        y: usize,
        xs: &[usize],
        search: Search,
    ) -> &[Vec<Match>] {
        let Size { height, width } = size;
        self.groups.resize(xs.len(), Vec::new());
        for (group, &x) in self.groups.iter_mut().zip(xs) {
            group.clear();
            group.push(Match { distance: 0.0, at: (y * width + x) as u32 });
        }
        self.bounds.clear();
        let bound =
            if search.max_blocks > 1 { search.threshold * (BLOCK * BLOCK) as f32 } else { 0.0 };
        self.bounds.resize(xs.len(), bound);
        let reach = search.radius as isize;
        // From the middle outwards: the best blocks tend to be near, so the bounds fall soon.
        let outwards = || (0..=2 * reach).map(|k| if k % 2 == 0 { -k / 2 } else { (k + 1) / 2 });
        for dy in outwards() {
            let Some(other) = y.checked_add_signed(dy).filter(|other| other + BLOCK <= height)
            else {
                continue;
            };
            for dx in outwards().filter(|&dx| (dx, dy) != (0, 0)) {
                let first = (-dx).max(0) as usize;
                let Some(last) = (width as isize - dx.max(0)).checked_sub_unsigned(first + BLOCK)
                else {
                    continue;
                };
                if last >= 0 {
                    self.compare(image, width, [y, other], first, last as usize + BLOCK, dx);
                    self.collect(first, last as usize, other * width, xs, dx, search.max_blocks);
                }
            }
        }
        &self.groups
    }

    /// Computes the squared differences of blocks at displacement `dx`. `columns` receives the sums over
    /// eight rows and eight columns, starting with column `first`.
    fn compare(
        &mut self,
        image: &[f32],
        width: usize,
        [y, other]: [usize; 2],
        first: usize,
        n: usize,
        dx: isize,
    ) {
        for buffer in [&mut self.columns, &mut self.pairs, &mut self.fours] {
            buffer.resize(width + BLOCK, 0.0);
        }
        let there = first.wrapping_add_signed(dx);
        let columns = &mut self.columns[..n];
        let a: [&[f32]; BLOCK] = std::array::from_fn(|r| &image[(y + r) * width + first..][..n]);
        let b: [&[f32]; BLOCK] =
            std::array::from_fn(|r| &image[(other + r) * width + there..][..n]);
        square_differences(a, b, columns);
        sum_neighbours(&self.columns[..n], 1, &mut self.pairs[..n - 1]);
        sum_neighbours(&self.pairs[..n - 1], 2, &mut self.fours[..n - 3]);
        sum_neighbours(&self.fours[..n - 3], 4, &mut self.columns[..n - 7]);
    }

    /// Inserts the blocks at displacement `dx` into their groups; [`Self::compare`] must have computed their
    /// distances.
    fn collect(
        &mut self,
        first: usize,
        last: usize,
        row: usize,
        xs: &[usize],
        dx: isize,
        max_blocks: usize,
    ) {
        let inside = xs.partition_point(|&x| x < first)..xs.partition_point(|&x| x <= first + last);
        for i in inside {
            let distance = self.columns[xs[i] - first];
            if distance < self.bounds[i] {
                let group = &mut self.groups[i];
                if group.len() == max_blocks {
                    group.pop();
                }
                let at = (row + xs[i].wrapping_add_signed(dx)) as u32;
                // The reference block stays first, also among equal blocks.
                let place = 1 + group[1..].partition_point(|other| other.distance <= distance);
                group.insert(place, Match { distance, at });
                if group.len() == max_blocks {
                    self.bounds[i] = group[max_blocks - 1].distance;
                }
            }
        }
    }
}

/// Computes `out[x]`, the sum over eight rows of the squared differences at column `x`.
#[multiversion(targets("x86_64+avx2"))]
fn square_differences(a: [&[f32]; BLOCK], b: [&[f32]; BLOCK], out: &mut [f32]) {
    let n = out.len();
    let ([a0, a1, a2, a3, a4, a5, a6, a7], [b0, b1, b2, b3, b4, b5, b6, b7]) =
        (a.map(|row| &row[..n]), b.map(|row| &row[..n]));
    let square = |a: f32, b: f32| (a - b) * (a - b);
    for x in 0..n {
        let upper = (square(a0[x], b0[x]) + square(a1[x], b1[x]))
            + (square(a2[x], b2[x]) + square(a3[x], b3[x]));
        let lower = (square(a4[x], b4[x]) + square(a5[x], b5[x]))
            + (square(a6[x], b6[x]) + square(a7[x], b7[x]));
        out[x] = upper + lower;
    }
}

/// Computes `out[x] = sums[x] + sums[x + step]`.
#[multiversion(targets("x86_64+avx2"))]
fn sum_neighbours(sums: &[f32], step: usize, out: &mut [f32]) {
    for ((out, a), b) in out.iter_mut().zip(sums).zip(&sums[step..]) {
        *out = a + b;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares block matching with an exhaustive search, at every border and with a full group.
    #[test]
    fn block_matching_equals_exhaustive_search() {
        let size = Size { height: 23, width: 30 };
        let image: Vec<f32> =
            (0..size.pixels()).map(|i| ((i * i * 31 + i * 7) % 101) as f32).collect();
        let xs: Vec<usize> = (0..=22).step_by(3).chain([22]).collect();
        let mut matcher = Matcher::default();
        for y in [0, 6, 15] {
            let search = Search { step: 3, radius: 9, max_blocks: 6, threshold: 2500.0 };
            let groups = matcher.groups(&image, size, y, &xs, search).to_vec();
            for (&x, group) in xs.iter().zip(&groups) {
                let mut expected = Vec::new();
                for v in y.saturating_sub(9)..=(y + 9).min(15) {
                    for u in x.saturating_sub(9)..=(x + 9).min(22) {
                        let mut sum = 0.0;
                        for (r, c) in (0..8).flat_map(|r| (0..8).map(move |c| (r, c))) {
                            let d = image[(y + r) * 30 + x + c] - image[(v + r) * 30 + u + c];
                            sum += d * d;
                        }
                        if sum < 2500.0 * 64.0 {
                            expected.push(sum);
                        }
                    }
                }
                expected.sort_by(f32::total_cmp);
                expected.truncate(6);
                let found: Vec<f32> = group.iter().map(|m| m.distance).collect();
                assert_eq!(found, expected, "block at {x}, {y}");
                assert_eq!(group[0].at as usize, y * 30 + x);
            }
        }
    }

    /// Checks that a texture repeated 5 columns and 3 rows away is found there.
    #[test]
    fn known_shifts_are_found() {
        let size = Size { height: 32, width: 40 };
        let texture = |x: usize, y: usize| ((x * 7919 + y * 104_729) % 251) as f32;
        let mut image: Vec<f32> = (0..size.pixels()).map(|i| texture(i % 40, i / 40)).collect();
        for (r, c) in (0..8).flat_map(|r| (0..8).map(move |c| (r, c))) {
            image[(12 + 3 + r) * 40 + 15 + 5 + c] = 1000.0 + (r * 8 + c) as f32;
            image[(4 + r) * 40 + 4 + c] = 1000.0 + (r * 8 + c) as f32;
        }
        let search = Search { step: 3, radius: 19, max_blocks: 2, threshold: 1.0 };
        let groups = Matcher::default().groups(&image, size, 4, &[4], search).to_vec();
        assert_eq!(groups[0].len(), 2);
        assert_eq!(groups[0][1], Match { distance: 0.0, at: 15 * 40 + 20 });
    }
}
