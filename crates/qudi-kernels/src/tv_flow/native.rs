//! TV-L1 flow on slices of memory.

use super::{DUAL_STEPS, EPSILON, ITERATIONS, LAMBDA, TAU, THETA, WARPS};
use crate::uninitialised::written;
use crate::warp::cubic;
use multiversion::multiversion;
use rayon::prelude::*;

/// Computes [`tv_flow`](super::tv_flow).
pub(super) fn flow(images: [&[f32]; 2], start: &[f32], size: [usize; 2]) -> Vec<f32> {
    let plane = size[0] * size[1];
    written(start.len(), |result| {
        result.copy_from_slice(start);
        let pairs = images[0].par_chunks_exact(plane).zip(images[1].par_chunks_exact(plane));
        result.par_chunks_exact_mut(2 * plane).zip(pairs).for_each(|(flow, (reference, other))| {
            of_pair([reference, other], flow, size);
        });
    })
}

/// Images of one pair that stay the same between two warps.
struct Linearized {
    /// Gradient of the warped neighbour along x and y.
    gradient: [Vec<f32>; 2],
    /// Its inverse square.
    inverse: Vec<f32>,
    /// Difference of the images for a flow of zero.
    rest: Vec<f32>,
}

/// Refines the flow of one pair, `[2, height, width]`.
fn of_pair([reference, neighbour]: [&[f32]; 2], flow: &mut [f32], [height, width]: [usize; 2]) {
    let plane = height * width;
    let mut dual = [(); 4].map(|()| vec![0.0; plane]);
    let mut fitted = vec![0.0; plane];
    for _ in 0..WARPS {
        let warped = cubic::forward([1, 1, height, width], neighbour, flow);
        let fixed = linearized(reference, &warped, flow, [height, width]);
        for _ in 0..ITERATIONS {
            fit(&fixed, flow);
            let (x, y) = flow.split_at_mut(plane);
            let (x_dual, y_dual) = dual.split_at_mut(2);
            for (flow, dual) in [(x, x_dual), (y, y_dual)] {
                fitted.copy_from_slice(flow);
                for _ in 0..DUAL_STEPS {
                    smooth(flow, &fitted, dual, width);
                }
            }
        }
    }
}

/// Linearizes the difference of the images around the flow.
fn linearized(
    reference: &[f32],
    warped: &[f32],
    flow: &[f32],
    [height, width]: [usize; 2],
) -> Linearized {
    let plane = height * width;
    let mut gradient = [(); 2].map(|()| Vec::with_capacity(plane));
    for y in 0..height {
        let row = |y: usize| &warped[y * width..][..width];
        let (above, here, below) = (row(y.saturating_sub(1)), row(y), row((y + 1).min(height - 1)));
        let [along_x, along_y] = &mut gradient;
        along_x.extend(
            (0..width).map(|x| (here[(x + 1).min(width - 1)] - here[x.saturating_sub(1)]) * 0.5),
        );
        along_y.extend(above.iter().zip(below).map(|(above, below)| (below - above) * 0.5));
    }
    let [along_x, along_y] = &gradient;
    let slopes = || along_x.iter().zip(along_y);
    let flows = flow[..plane].iter().zip(&flow[plane..]);
    let rest = warped.iter().zip(reference).zip(slopes()).zip(flows);
    let rest = rest
        .map(|(((warped, reference), (gx, gy)), (x, y))| warped - reference - (gx * x + gy * y));
    let rest = rest.collect();
    let inverse = slopes().map(|(x, y)| 1.0 / (x * x + y * y + EPSILON)).collect();
    Linearized { gradient, inverse, rest }
}

/// Moves the flow of every pixel along the gradient to where the images agree, but no farther than the
/// differences are worth (Zach et al. 2007, eq. 15).
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn fit(fixed: &Linearized, flow: &mut [f32]) {
    const MAX_LENGTH: f32 = LAMBDA * THETA;
    let Linearized { gradient: [along_x, along_y], inverse, rest } = fixed;
    let plane = rest.len();
    let (x, y) = flow.split_at_mut(plane);
    let (y, along_x, along_y) = (&mut y[..plane], &along_x[..plane], &along_y[..plane]);
    let (x, inverse) = (&mut x[..plane], &inverse[..plane]);
    for i in 0..plane {
        let difference = rest[i] + (along_x[i] * x[i] + along_y[i] * y[i]);
        let length = (difference * inverse[i]).clamp(-MAX_LENGTH, MAX_LENGTH);
        x[i] -= length * along_x[i];
        y[i] -= length * along_y[i];
    }
}

/// Takes one step of the dual variables of a component of the flow, which becomes `fitted` plus their
/// divergence (eq. 10 to 12).
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn smooth(flow: &mut [f32], fitted: &[f32], dual: &mut [Vec<f32>], width: usize) {
    const STEP: f32 = TAU / THETA;
    let height = flow.len() / width;
    let [across, down] = dual else { return };
    for row in 0..height {
        let at = row * width;
        let here = &flow[at..][..width];
        let below = if row + 1 < height { &flow[at + width..][..width] } else { here };
        let (across, down) = (&mut across[at..][..width], &mut down[at..][..width]);
        for x in 0..width - 1 {
            let (dx, dy) = (here[x + 1] - here[x], below[x] - here[x]);
            let norm = 1.0 / (STEP * (dx * dx + dy * dy).sqrt() + 1.0);
            across[x] = (across[x] + STEP * dx) * norm;
            down[x] = (down[x] + STEP * dy) * norm;
        }
        let dy = below[width - 1] - here[width - 1];
        down[width - 1] = (down[width - 1] + STEP * dy) / (STEP * dy.abs() + 1.0);
    }
    for row in 0..height {
        let at = row * width;
        let fitted = &fitted[at..][..width];
        let (across, down) = (&across[at..][..width], &down[..at + width]);
        let (above, down) = down.split_at(at);
        let flow = &mut flow[at..][..width];
        if row == 0 {
            for x in 0..width {
                flow[x] = fitted[x] + THETA * (across[x] + down[x]);
            }
        } else {
            let above = &above[at - width..][..width];
            for x in 0..width {
                flow[x] = fitted[x] + THETA * (across[x] + down[x] - above[x]);
            }
        }
        for x in 1..width {
            flow[x] -= THETA * across[x - 1];
        }
    }
}
