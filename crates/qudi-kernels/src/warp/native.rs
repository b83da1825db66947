//! Warping and its gradients on slices of memory.

use crate::uninitialised::fill;
use rayon::prelude::*;

/// Number of planes per task, which share the computation of source positions.
const PLANES_PER_TASK: usize = 8;

/// Source position of one pixel of the result.
#[derive(Clone, Copy, Debug)]
struct Place {
    /// Indices of the pixels above left, above right, below left and below right.
    corners: [u32; 4],
    /// Weight of the right pixels.
    right: f32,
    below: f32,
    /// True for each of x and y that was not clamped.
    free: [bool; 2],
}

/// Computes the source positions of all pixels; `flow` is `[2, height, width]`.
fn places(flow: &[f32], height: usize, width: usize) -> Vec<Place> {
    let (x_flow, y_flow) = flow.split_at(height * width);
    let mut places = Vec::with_capacity(height * width);
    for row in 0..height {
        for column in 0..width {
            let at = row * width + column;
            let (left, x_next, right, x_free) = split(column as f32 + x_flow[at], width);
            let (above, y_next, below, y_free) = split(row as f32 + y_flow[at], height);
            let corner = |y: usize, x: usize| (y * width + x) as u32;
            places.push(Place {
                corners: [
                    corner(above, left),
                    corner(above, x_next),
                    corner(y_next, left),
                    corner(y_next, x_next),
                ],
                right,
                below,
                free: [x_free, y_free],
            });
        }
    }
    places
}

/// Returns the two neighbours of a clamped coordinate, the weight of the second, and true if it was not
/// clamped. NaN counts as the first coordinate.
fn split(coordinate: f32, size: usize) -> (usize, usize, f32, bool) {
    let last = (size - 1) as f32;
    let clamped = coordinate.max(0.0).min(last);
    let first = clamped as usize;
    (
        first,
        (first + 1).min(size - 1),
        clamped - first as f32,
        coordinate > 0.0 && coordinate < last,
    )
}

/// Computes [`warp`](super::warp).
pub(super) fn forward(shape: [usize; 4], x: &[f32], flow: &[f32]) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    let shares = channels.div_ceil(PLANES_PER_TASK);
    fill(x.len(), |result| {
        // Each task takes a few planes of one image.
        let images = result.chunks_mut(channels * plane).zip(x.chunks(channels * plane));
        let tasks: Vec<_> = images
            .zip(flow.chunks(2 * plane))
            .flat_map(|((result, x), flow)| {
                let parts = result
                    .chunks_mut(PLANES_PER_TASK * plane)
                    .zip(x.chunks(PLANES_PER_TASK * plane));
                parts.map(move |(result, x)| (result, x, flow))
            })
            .collect();
        debug_assert_eq!(tasks.len(), shape[0] * shares);
        tasks.into_par_iter().for_each(|(result, x, flow)| {
            let places = places(flow, height, width);
            for (result, x) in result.chunks_mut(plane).zip(x.chunks(plane)) {
                for (result, place) in result.iter_mut().zip(&places) {
                    let [a, b, c, d] = place.corners.map(|corner| x[corner as usize]);
                    let above = (b - a) * place.right + a;
                    let below = (d - c) * place.right + c;
                    result.write((below - above) * place.below + above);
                }
            }
        });
    })
}

/// Computes the gradients of `x` and `flow`, those that are `requested`.
pub(super) fn gradients(
    shape: [usize; 4],
    x: &[f32],
    flow: &[f32],
    gradient: &[f32],
    requested: [bool; 2],
) -> [Option<Vec<f32>>; 2] {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    let (image, of_flow) = (channels * plane, 2 * plane);
    let dx = requested[0].then(|| {
        let mut dx = vec![0.0; x.len()];
        let images = dx.par_chunks_mut(image).zip(flow.par_chunks(of_flow));
        images.zip(gradient.par_chunks(image)).for_each(|((dx, flow), gradient)| {
            let places = places(flow, height, width);
            for (dx, gradient) in dx.chunks_mut(plane).zip(gradient.chunks(plane)) {
                for (place, &gradient) in places.iter().zip(gradient) {
                    let [a, b, c, d] = place.corners.map(|corner| corner as usize);
                    let (right, below) = (place.right, place.below);
                    dx[a] += gradient * (1.0 - right) * (1.0 - below);
                    dx[b] += gradient * right * (1.0 - below);
                    dx[c] += gradient * (1.0 - right) * below;
                    dx[d] += gradient * right * below;
                }
            }
        });
        dx
    });
    let dflow = requested[1].then(|| {
        let mut dflow = vec![0.0; flow.len()];
        let images = dflow.par_chunks_mut(of_flow).zip(flow.par_chunks(of_flow));
        let images = images.zip(x.par_chunks(image)).zip(gradient.par_chunks(image));
        images.for_each(|(((dflow, flow), x), gradient)| {
            let places = places(flow, height, width);
            let (x_flow, y_flow) = dflow.split_at_mut(plane);
            for (x, gradient) in x.chunks(plane).zip(gradient.chunks(plane)) {
                for (at, (place, &gradient)) in places.iter().zip(gradient).enumerate() {
                    let [a, b, c, d] = place.corners.map(|corner| x[corner as usize]);
                    let (right, below) = (place.right, place.below);
                    if place.free[0] {
                        let slope = (b - a) * (1.0 - below) + (d - c) * below;
                        x_flow[at] += gradient * slope;
                    }
                    if place.free[1] {
                        let slope = (c - a) * (1.0 - right) + (d - b) * right;
                        y_flow[at] += gradient * slope;
                    }
                }
            }
        });
        dflow
    });
    [dx, dflow]
}
