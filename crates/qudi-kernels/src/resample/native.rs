//! Maps on slices of memory, plane by plane.

use super::Resampling;
use crate::uninitialised::written;
use rayon::prelude::*;

/// Values of a task: smaller ones are not worth a thread's attention.
const TASK: usize = 1 << 15;

/// Applies a map to `x`, of shape `from`; the result has shape `to`.
pub(super) fn resample(x: &[f32], from: [usize; 4], how: Resampling, to: [usize; 4]) -> Vec<f32> {
    let length = to.iter().product();
    // Planes that one call of the map reads and writes: shuffles mix the channels of a square.
    let [read, write] = match how {
        Resampling::Unshuffle(fold) => [1, fold * fold],
        Resampling::Shuffle(fold) => [fold * fold, 1],
        _ => [1, 1],
    };
    let (read, write) = (read * from[2] * from[3], write * to[2] * to[3]);
    let width = from[3];
    let calls = (TASK / write).max(1);
    written(length, |result| {
        let tasks = result.par_chunks_mut(calls * write).zip(x.par_chunks(calls * read));
        tasks.for_each(|(to, from)| {
            let mut between = Vec::new();
            for (to, from) in to.chunks_exact_mut(write).zip(from.chunks_exact(read)) {
                match how {
                    Resampling::Unshuffle(fold) => unshuffle(from, width, fold, to),
                    Resampling::Shuffle(fold) => shuffle(from, width, fold, to),
                    Resampling::Pool => pool(from, width, to),
                    Resampling::Unpool => unpool(from, width, to),
                    Resampling::Upsample => upsample(from, width, to, &mut between),
                    Resampling::Downsample => downsample(from, width, to, &mut between),
                }
            }
        });
    })
}

/// Moves squares of a plane into `fold * fold` planes.
fn unshuffle(from: &[f32], width: usize, fold: usize, to: &mut [f32]) {
    let plane = from.len() / (fold * fold);
    for (number, to) in to.chunks_exact_mut(plane).enumerate() {
        let (row, column) = (number / fold, number % fold);
        let rows = from.chunks_exact(width).skip(row).step_by(fold);
        for (to, from) in to.chunks_exact_mut(width / fold).zip(rows) {
            for (to, from) in to.iter_mut().zip(from.chunks_exact(fold)) {
                *to = from[column];
            }
        }
    }
}

/// Moves `fold * fold` planes into the squares of one.
fn shuffle(from: &[f32], width: usize, fold: usize, to: &mut [f32]) {
    let plane = from.len() / (fold * fold);
    for (number, from) in from.chunks_exact(plane).enumerate() {
        let (row, column) = (number / fold, number % fold);
        let rows = to.chunks_exact_mut(width * fold).skip(row).step_by(fold);
        for (from, to) in from.chunks_exact(width).zip(rows) {
            for (&from, to) in from.iter().zip(to.chunks_exact_mut(fold)) {
                to[column] = from;
            }
        }
    }
}

/// Averages squares of 2 x 2 pixels.
fn pool(from: &[f32], width: usize, to: &mut [f32]) {
    for (to, rows) in to.chunks_exact_mut(width / 2).zip(from.chunks_exact(2 * width)) {
        let (first, second) = rows.split_at(width);
        let pairs = first.chunks_exact(2).zip(second.chunks_exact(2));
        for (to, (first, second)) in to.iter_mut().zip(pairs) {
            *to = (first[0] + first[1] + second[0] + second[1]) * 0.25;
        }
    }
}

/// Gives a quarter of each pixel to 2 x 2 pixels.
fn unpool(from: &[f32], width: usize, to: &mut [f32]) {
    for (from, rows) in from.chunks_exact(width).zip(to.chunks_exact_mut(4 * width)) {
        let (first, second) = rows.split_at_mut(2 * width);
        for (&from, to) in from.iter().zip(first.chunks_exact_mut(2)) {
            to.fill(from * 0.25);
        }
        second.copy_from_slice(first);
    }
}

/// The shares of the nearer and of the farther pixel.
const NEAR: f32 = 0.75;
const FAR: f32 = 0.25;

/// Doubles the size: rows first, then columns.
pub(crate) fn upsample(from: &[f32], width: usize, to: &mut [f32], between: &mut Vec<f32>) {
    let height = from.len() / width;
    let row = |row: usize| &from[row * width..][..width];
    between.resize(2 * from.len(), 0.0);
    for (at, rows) in between.chunks_exact_mut(2 * width).enumerate() {
        let (before, after) = rows.split_at_mut(width);
        let (above, below) = (row(at.saturating_sub(1)), row((at + 1).min(height - 1)));
        for (column, &x) in row(at).iter().enumerate() {
            before[column] = x * NEAR + above[column] * FAR;
            after[column] = x * NEAR + below[column] * FAR;
        }
    }
    for (from, to) in between.chunks_exact(width).zip(to.chunks_exact_mut(2 * width)) {
        for (column, to) in to.chunks_exact_mut(2).enumerate() {
            let (left, right) = (column.saturating_sub(1), (column + 1).min(width - 1));
            to[0] = from[column] * NEAR + from[left] * FAR;
            to[1] = from[column] * NEAR + from[right] * FAR;
        }
    }
}

/// Halves the size: each pixel receives from those that [`upsample`] gave it to.
fn downsample(from: &[f32], width: usize, to: &mut [f32], between: &mut Vec<f32>) {
    let (half, height) = (width / 2, from.len() / width);
    between.resize(height * half, 0.0);
    for (from, to) in from.chunks_exact(width).zip(between.chunks_exact_mut(half)) {
        for (column, to) in to.iter_mut().enumerate() {
            let (first, second) = (2 * column, 2 * column + 1);
            // At the edges a pixel is its own neighbour.
            let (before, after) = (first.saturating_sub(1), (second + 1).min(width - 1));
            *to = (from[first] + from[second]) * NEAR + (from[before] + from[after]) * FAR;
        }
    }
    let row = |row: usize| &between[row * half..][..half];
    for (at, to) in to.chunks_exact_mut(half).enumerate() {
        let (first, second) = (row(2 * at), row(2 * at + 1));
        let (before, after) = (row((2 * at).saturating_sub(1)), row((2 * at + 2).min(height - 1)));
        for (column, to) in to.iter_mut().enumerate() {
            *to = (first[column] + second[column]) * NEAR + (before[column] + after[column]) * FAR;
        }
    }
}
