//! Cubic convolution (Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 1981).

use super::positions;
#[cfg(feature = "flex")]
use crate::uninitialised::fill;
use burn::tensor::{Int, Tensor};
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
#[derive(Clone, Copy, Debug)]
struct Taps {
    places: [usize; TAPS],
    weights: [f32; TAPS],
    /// True if they are neighbours: none lies beyond an edge.
    inside: bool,
}

#[cfg(feature = "flex")]
impl Taps {
    /// Returns the taps of a coordinate among `size` pixels. NaN counts as the first coordinate.
    fn new(coordinate: f32, size: usize) -> Self {
        let clamped = coordinate.max(-BEYOND).min(size as f32 + BEYOND);
        // The whole number below, without a call of the mathematical library.
        let whole = clamped as isize;
        let first = whole - isize::from(clamped < whole as f32);
        let t = clamped - first as f32;
        let place = |k: usize| (first + k as isize - 1).clamp(0, size as isize - 1);
        Self {
            places: std::array::from_fn(|k| place(k) as usize),
            weights: WEIGHTS.map(|[a, b, c, d]| ((d * t + c) * t + b) * t + a),
            inside: first >= 1 && first + 2 < size as isize,
        }
    }
}

/// Rows of a plane per task.
#[cfg(feature = "flex")]
const ROWS_PER_TASK: usize = 32;

/// Calls `visit` with the number of every pixel of some rows, counted from the first of them, and its taps
/// along rows and columns; `flow` is `[2, height, width]`.
#[cfg(feature = "flex")]
fn visit(
    flow: &[f32],
    rows: Range<usize>,
    [height, width]: [usize; 2],
    mut visit: impl FnMut(usize, Taps, Taps),
) {
    let (x_flow, y_flow) = flow.split_at(height * width);
    for (row, first) in rows.clone().zip((0..).step_by(width)) {
        let at = row * width;
        let displacements = x_flow[at..][..width].iter().zip(&y_flow[at..][..width]);
        for (column, (dx, dy)) in displacements.enumerate() {
            let x = Taps::new(column as f32 + dx, width);
            let y = Taps::new(row as f32 + dy, height);
            visit(first + column, x, y);
        }
    }
}

/// Computes [`warp_cubic`](super::warp_cubic).
#[cfg(feature = "flex")]
pub(crate) fn forward(shape: [usize; 4], x: &[f32], flow: &[f32]) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    let rows_of = |task: usize| {
        let first = task * ROWS_PER_TASK;
        first..(first + ROWS_PER_TASK).min(height)
    };
    fill(x.len(), |result| {
        let planes = result.par_chunks_mut(plane).zip(x.par_chunks(plane)).enumerate();
        planes.for_each(|(number, (result, x))| {
            let flow = &flow[number / channels * 2 * plane..][..2 * plane];
            let tasks = result.par_chunks_mut(ROWS_PER_TASK * width).enumerate();
            tasks.for_each(|(task, result)| {
                visit(flow, rows_of(task), [height, width], |at, columns, rows| {
                    let row = |row: usize| {
                        let x = &x[row * width..][..width];
                        let values = if columns.inside {
                            let x = &x[columns.places[0]..][..TAPS];
                            [x[0], x[1], x[2], x[3]]
                        } else {
                            columns.places.map(|place| x[place])
                        };
                        let products = values.iter().zip(columns.weights);
                        products.map(|(value, weight)| value * weight).sum::<f32>()
                    };
                    let taps = rows.places.iter().zip(rows.weights);
                    result[at].write(taps.map(|(&place, weight)| row(place) * weight).sum());
                });
            });
        });
    })
}

/// Computes the gradient of `x`.
#[cfg(feature = "flex")]
pub(super) fn gradient(shape: [usize; 4], flow: &[f32], gradient: &[f32]) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    let mut dx = vec![0.0; gradient.len()];
    let images = dx.par_chunks_mut(channels * plane).zip(gradient.par_chunks(channels * plane));
    images.zip(flow.par_chunks(2 * plane)).for_each(|((dx, gradient), flow)| {
        visit(flow, 0..height, [height, width], |at, columns, rows| {
            for (dx, gradient) in dx.chunks_mut(plane).zip(gradient.chunks(plane)) {
                for (row, weight) in rows.places.iter().zip(rows.weights) {
                    let dx = &mut dx[row * width..][..width];
                    let gradient = gradient[at] * weight;
                    for (&place, weight) in columns.places.iter().zip(columns.weights) {
                        dx[place] += gradient * weight;
                    }
                }
            }
        });
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
