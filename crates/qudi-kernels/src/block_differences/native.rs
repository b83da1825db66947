//! Differences of blocks on slices of memory.

use super::BLOCK_RADIUS;
use crate::uninitialised::written;
use rayon::prelude::*;

/// Pixels beyond the edge that the means read.
const MARGIN: usize = 2 * BLOCK_RADIUS;

/// Computes [`block_differences`](super::block_differences).
pub(super) fn differences(
    reference: &[f32],
    neighbour: &[f32],
    [height, width]: [usize; 2],
    radius: usize,
) -> Vec<f32> {
    let plane = height * width;
    let side = 2 * radius + 1;
    let length = reference.len() * side * side;
    written(length, |result| {
        let pairs = reference.par_chunks_exact(plane).zip(neighbour.par_chunks_exact(plane));
        let results = result.par_chunks_exact_mut(side * side * plane);
        results.zip(pairs).for_each(|(result, (reference, neighbour))| {
            let mut scratch = [const { Vec::new() }; 3];
            for (number, result) in result.chunks_exact_mut(plane).enumerate() {
                let place = [number / side, number % side];
                let displaced = |at: usize, offset: usize, size: usize| {
                    (at + offset).saturating_sub(radius).min(size - 1)
                };
                let squares = &mut scratch[0];
                squares.clear();
                for (row, reference) in reference.chunks_exact(width).enumerate() {
                    let from = &neighbour[displaced(row, place[0], height) * width..][..width];
                    squares.extend(reference.iter().enumerate().map(|(column, reference)| {
                        let difference = from[displaced(column, place[1], width)] - reference;
                        difference * difference
                    }));
                }
                block_means(&mut scratch, [height, width], result);
            }
        });
    })
}

/// Averages the squares in `scratch[0]` over blocks: rows first, then columns; nine as three threes.
fn block_means(scratch: &mut [Vec<f32>; 3], [height, width]: [usize; 2], result: &mut [f32]) {
    const COUNT: f32 = (MARGIN + 1) as f32;
    let [squares, threes, rows] = scratch;
    let row = |at: usize| {
        let at = at.saturating_sub(BLOCK_RADIUS).min(height - 1);
        &squares[at * width..][..width]
    };
    threes.clear();
    for at in 0..height + MARGIN - 2 {
        let (a, b, c) = (row(at), row(at + 1), row(at + 2));
        threes.extend(a.iter().zip(b).zip(c).map(|((a, b), c)| a + b + c));
    }
    rows.clear();
    for at in 0..height {
        let three = |k: usize| &threes[(at + 3 * k) * width..][..width];
        let sums = three(0).iter().zip(three(1)).zip(three(2));
        rows.extend(sums.map(|((a, b), c)| (a + b + c) / COUNT));
    }
    let (padded, threes) = (squares, threes);
    for (from, to) in rows.chunks_exact(width).zip(result.chunks_exact_mut(width)) {
        padded.clear();
        padded.resize(BLOCK_RADIUS, from[0]);
        padded.extend_from_slice(from);
        padded.resize(width + MARGIN, from[width - 1]);
        threes.clear();
        threes.extend(padded.windows(3).map(|three| three[0] + three[1] + three[2]));
        for (column, to) in to.iter_mut().enumerate() {
            *to = (threes[column] + threes[column + 3] + threes[column + 6]) / COUNT;
        }
    }
}
