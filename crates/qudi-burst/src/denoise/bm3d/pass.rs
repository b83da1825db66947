//! One pass of BM3D over the image: grouping, filtering, and the weighted mean of overlapping estimates.
//!
//! Strips of rows are processed in parallel, each into its own buffers. The buffers are added in order, so
//! the sums are the same with any number of threads.

use super::block::{BLOCK, Block, add_row, load};
use super::filter::Filter;
use super::matching::{Match, Matcher, Search};
use qudi_core::{Frame, Size};
use rayon::prelude::*;
use wide::f32x8;

/// Rows of reference blocks in a strip. It affects the rounding of the result, so it does not depend on the
/// machine.
const STRIP_ROWS: usize = 8;

/// Maximum number of blocks in a group.
const MAX_GROUP_SIZE: usize = 32;

/// Kaiser window of 8 samples with beta = 2, the weights of a block's pixels (section IV-B):
/// `I0(2 sqrt(1 - (2k/7 - 1)^2)) / I0(2)`.
const KAISER: [f32; BLOCK] = [
    0.438_676_3,
    0.681_324_3,
    0.876_839_9,
    0.985_822_5,
    0.985_822_5,
    0.876_839_9,
    0.681_324_3,
    0.438_676_3,
];

/// Filters `noisy` in groups of blocks that are similar in `guide`.
pub(crate) fn pass(noisy: &Frame, guide: &Frame, search: Search, filter: Filter) -> Frame {
    let size = noisy.size;
    let rows = corners(size.height, search.step);
    let columns = corners(size.width, search.step);
    let strips: Vec<Strip> = rows
        .par_chunks(STRIP_ROWS)
        .map(|rows| {
            let mut strip = Strip::new(size, rows, search.radius);
            let mut matcher = Matcher::default();
            for &y in rows {
                for group in matcher.groups(&guide.data, size, y, &columns, search) {
                    strip.filter(noisy, guide, group, filter);
                }
            }
            strip
        })
        .collect();
    let mut sums = vec![0.0; size.pixels()];
    let mut weights = vec![0.0; size.pixels()];
    for strip in &strips {
        let range = strip.first * size.width..;
        for (total, part) in sums[range.clone()].iter_mut().zip(&strip.sums) {
            *total += part;
        }
        for (total, part) in weights[range].iter_mut().zip(&strip.weights) {
            *total += part;
        }
    }
    // Every pixel lies in at least one reference block.
    let data = sums.iter().zip(&weights).map(|(sum, weight)| sum / weight).collect();
    Frame { size, data }
}

/// Returns the corners of reference blocks along a side of `length` pixels, `step` apart, the last one at its
/// end.
fn corners(length: usize, step: usize) -> Vec<usize> {
    let last = length - BLOCK;
    (0..last).step_by(step).chain([last]).collect()
}

/// Estimates of a strip of reference blocks.
struct Strip {
    width: usize,
    /// First image row of the strip.
    first: usize,
    sums: Vec<f32>,
    weights: Vec<f32>,
}

impl Strip {
    fn new(size: Size, corners: &[usize], radius: usize) -> Self {
        let first = corners[0].saturating_sub(radius);
        let end = (corners[corners.len() - 1] + radius + BLOCK).min(size.height);
        let pixels = (end - first) * size.width;
        Self { width: size.width, first, sums: vec![0.0; pixels], weights: vec![0.0; pixels] }
    }

    /// Filters one group and adds its blocks.
    fn filter(&mut self, noisy: &Frame, guide: &Frame, group: &[Match], filter: Filter) {
        let mut noisy_blocks: [Block; MAX_GROUP_SIZE] = [[f32x8::ZERO; BLOCK]; MAX_GROUP_SIZE];
        let mut guide_blocks: [Block; MAX_GROUP_SIZE] = [[f32x8::ZERO; BLOCK]; MAX_GROUP_SIZE];
        // Haar's transform needs a power of two.
        let n = 1 << group.len().ilog2();
        let transform = filter.transform();
        for (block, similar) in noisy_blocks.iter_mut().zip(&group[..n]) {
            *block = load(&noisy.data, self.width, similar.at as usize);
            transform.forward(block);
        }
        if let Filter::Wiener(_) = filter {
            for (block, similar) in guide_blocks.iter_mut().zip(&group[..n]) {
                *block = load(&guide.data, self.width, similar.at as usize);
                transform.forward(block);
            }
        }
        let weight = filter.apply(&mut noisy_blocks[..n], &mut guide_blocks[..n]);
        let window = f32x8::new(KAISER);
        for (block, similar) in noisy_blocks.iter_mut().zip(&group[..n]) {
            transform.inverse(block);
            let corner = similar.at as usize - self.first * self.width;
            for (r, row) in block.iter().enumerate() {
                let at = corner + r * self.width;
                let weights = window * f32x8::splat(weight * KAISER[r]);
                add_row(&mut self.sums[at..at + BLOCK], *row * weights);
                add_row(&mut self.weights[at..at + BLOCK], weights);
            }
        }
    }
}
