//! Cubic convolution (Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 1981).

use super::positions;
#[cfg(feature = "flex")]
use crate::uninitialised::written;
use burn::tensor::{Int, Tensor};
#[cfg(feature = "flex")]
use multiversion::multiversion;
#[cfg(feature = "flex")]
use rayon::prelude::*;
#[cfg(feature = "flex")]
use std::ops::Range;

/// Slope of the kernel one pixel away, as in PyTorch.
const A: f32 = -0.75;

/// Pixels of a row or column that a value is computed from.
const TAPS: usize = 4;

/// Coefficients of the weights of the taps as polynomials of the fraction, constant term first.
const WEIGHTS: [[f32; 4]; TAPS] = [
    [0.0, A, -2.0 * A, A],
    [1.0, 0.0, -(A + 3.0), A + 2.0],
    [0.0, -A, 2.0 * A + 3.0, -(A + 2.0)],
    [0.0, 0.0, A, -A],
];

/// Pixels beyond the edge where a coordinate changes nothing any more.
const BEYOND: f32 = 3.0;

/// The taps of one coordinate.
#[cfg(feature = "flex")]
#[derive(Clone, Copy, Debug, Default)]
struct Taps {
    /// The pixel before the first tap's next one: taps lie at `first - 1` to `first + 2`.
    first: i32,
    weights: [f32; TAPS],
}

#[cfg(feature = "flex")]
impl Taps {
    /// Returns the taps of a coordinate among `size` pixels. NaN counts as the first coordinate.
    #[inline(always)]
    fn new(coordinate: f32, size: usize) -> Self {
        let clamped = coordinate.max(-BEYOND).min(size as f32 + BEYOND);
        // The whole number below, without a call of the mathematical library.
        let whole = clamped as i32;
        let first = whole - i32::from(clamped < whole as f32);
        let t = clamped - first as f32;
        Self { first, weights: WEIGHTS.map(|[a, b, c, d]| ((d * t + c) * t + b) * t + a) }
    }

    /// Returns true if none of the taps lies beyond an edge.
    #[inline(always)]
    fn inside(&self, size: usize) -> bool {
        self.first >= 1 && self.first + 2 < size as i32
    }

    /// Returns the pixels of the taps; those beyond an edge are at the edge.
    #[inline(always)]
    fn places(&self, size: usize) -> [usize; TAPS] {
        let last = size as i32 - 1;
        std::array::from_fn(|k| (self.first + k as i32 - 1).clamp(0, last) as usize)
    }
}

/// Rows of a plane per task.
#[cfg(feature = "flex")]
const ROWS_PER_TASK: usize = 32;

/// Computes [`warp_cubic`](super::warp_cubic).
#[cfg(feature = "flex")]
pub(crate) fn forward(shape: [usize; 4], x: &[f32], flow: &[f32]) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    written(x.len(), |result| {
        // Each task takes a few rows of all planes of an image, which share their taps.
        let mut tasks = Vec::new();
        let images = result.chunks_mut(channels * plane).zip(x.chunks(channels * plane));
        for ((result, x), flow) in images.zip(flow.chunks(2 * plane)) {
            let mut rows: Vec<_> = result
                .chunks_mut(plane)
                .map(|plane| plane.chunks_mut(ROWS_PER_TASK * width))
                .collect();
            for first in (0..height).step_by(ROWS_PER_TASK) {
                let planes: Vec<_> = rows.iter_mut().filter_map(Iterator::next).collect();
                tasks.push((planes, x, flow, first..(first + ROWS_PER_TASK).min(height)));
            }
        }
        tasks.into_par_iter().for_each(|(mut planes, x, flow, rows)| {
            sample_rows(&mut planes, x, flow, rows, [height, width]);
        });
    })
}

/// Samples all planes of an image, `[channels, height, width]`, on one thread.
#[cfg(feature = "flex")]
pub(crate) fn sample(result: &mut [f32], x: &[f32], flow: &[f32], [height, width]: [usize; 2]) {
    let mut planes: Vec<_> = result.chunks_mut(height * width).collect();
    sample_rows(&mut planes, x, flow, 0..height, [height, width]);
}

/// Samples some rows of all planes of an image.
#[cfg(feature = "flex")]
#[multiversion(targets("x86_64+avx2+fma"))]
fn sample_rows(
    results: &mut [&mut [f32]],
    x: &[f32],
    flow: &[f32],
    rows: Range<usize>,
    [height, width]: [usize; 2],
) {
    let mut taps = vec![[Taps::default(); 2]; width];
    for (row, first) in rows.zip((0..).step_by(width)) {
        taps_of_row(&mut taps, flow, row, [height, width]);
        for (result, x) in results.iter_mut().zip(x.chunks_exact(height * width)) {
            let result = &mut result[first..][..width];
            for (result, [columns, rows]) in result.iter_mut().zip(&taps) {
                let mut sums = [0.0f32; TAPS];
                if columns.inside(width) && rows.inside(height) {
                    let corner = (rows.first - 1) as usize * width + (columns.first - 1) as usize;
                    let x = &x[corner..][..3 * width + TAPS];
                    for (row, weight) in rows.weights.iter().enumerate() {
                        let x = &x[row * width..][..TAPS];
                        for k in 0..TAPS {
                            sums[k] += weight * x[k];
                        }
                    }
                } else {
                    let places = columns.places(width);
                    for (row, weight) in rows.places(height).iter().zip(rows.weights) {
                        let x = &x[row * width..][..width];
                        for k in 0..TAPS {
                            sums[k] += weight * x[places[k]];
                        }
                    }
                }
                let [a, b, c, d] = std::array::from_fn(|k| sums[k] * columns.weights[k]);
                *result = (a + c) + (b + d);
            }
        }
    }
}

/// Computes the taps of the pixels of a row, along rows and columns; `flow` is `[2, height, width]`.
#[cfg(feature = "flex")]
#[inline(always)]
fn taps_of_row(taps: &mut [[Taps; 2]], flow: &[f32], row: usize, [height, width]: [usize; 2]) {
    let (dx, dy) = flow.split_at(height * width);
    let displacements = dx[row * width..].iter().zip(&dy[row * width..]);
    for (column, (taps, (dx, dy))) in taps.iter_mut().zip(displacements).enumerate() {
        *taps = [Taps::new(column as f32 + dx, width), Taps::new(row as f32 + dy, height)];
    }
}

/// Computes the gradient of `x`.
#[cfg(feature = "flex")]
pub(super) fn gradient(shape: [usize; 4], flow: &[f32], gradient: &[f32]) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    let mut dx = vec![0.0; gradient.len()];
    let images = dx.par_chunks_mut(channels * plane).zip(gradient.par_chunks(channels * plane));
    images.zip(flow.par_chunks(2 * plane)).for_each(|((dx, gradient), flow)| {
        let mut taps = vec![[Taps::default(); 2]; width];
        for row in 0..height {
            taps_of_row(&mut taps, flow, row, [height, width]);
            for (at, [columns, rows]) in (row * width..).zip(&taps) {
                let (rows, weights) = (rows.places(height), rows.weights);
                let places = columns.places(width);
                for (dx, gradient) in dx.chunks_mut(plane).zip(gradient.chunks(plane)) {
                    for (row, weight) in rows.iter().zip(weights) {
                        let dx = &mut dx[row * width..][..width];
                        let gradient = gradient[at] * weight;
                        for (&place, weight) in places.iter().zip(columns.weights) {
                            dx[place] += gradient * weight;
                        }
                    }
                }
            }
        }
    });
    dx
}

/// Computes [`warp_cubic`](super::warp_cubic) by Burn's operations.
pub(super) fn composed(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let plane = height * width;
    let places = flow.permute([0, 2, 3, 1]) + positions(height, width, &x.device());
    let taps = |axis: usize, size: usize| {
        let place = places.clone().narrow(3, axis, 1).reshape([images, plane]);
        let place = place.clamp(-BEYOND, size as f32 + BEYOND);
        let first = place.clone().floor();
        let t = place - first.clone();
        let first = first.int();
        let tap = |k: usize| {
            let [a, b, c, d] = WEIGHTS[k];
            let weight = ((t.clone() * d + c) * t.clone() + b) * t.clone() + a;
            let place = (first.clone() + k as i32 - 1).clamp(0, size as i32 - 1);
            (place, weight)
        };
        std::array::from_fn::<(Tensor<2, Int>, Tensor<2>), TAPS, _>(tap)
    };
    let (columns, rows) = (taps(0, width), taps(1, height));
    let x = x.reshape([images, channels, plane]);
    let mut sum = x.zeros_like();
    for (row, row_weight) in &rows {
        for (column, column_weight) in &columns {
            let at = row.clone() * width as i32 + column.clone();
            let at = at.reshape([images, 1, plane]).expand([images, channels, plane]);
            let weight = (row_weight.clone() * column_weight.clone()).reshape([images, 1, plane]);
            sum = sum + x.clone().gather(2, at) * weight;
        }
    }
    sum.reshape([images, channels, height, width])
}
