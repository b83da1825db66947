//! TV-L1 flow by Burn's operations, for graphics cards.

use super::{DUAL_STEPS, EPSILON, ITERATIONS, LAMBDA, TAU, THETA, WARPS};
use crate::warp::warp_cubic;
use burn::tensor::Tensor;
use burn::tensor::ops::PadMode;

/// Computes [`tv_flow`](super::tv_flow).
pub(super) fn tv_flow(reference: &Tensor<4>, neighbour: &Tensor<4>, start: Tensor<4>) -> Tensor<4> {
    let most = LAMBDA * THETA;
    let mut flow = start;
    let mut dual = [3, 2].map(|_| flow.zeros_like());
    for _ in 0..WARPS {
        let warped = warp_cubic(neighbour.clone(), flow.clone());
        let gradient = [3, 2].map(|axis| central(&warped, axis));
        let along = |flow: &Tensor<4>| {
            gradient[0].clone() * flow.clone().narrow(1, 0, 1)
                + gradient[1].clone() * flow.clone().narrow(1, 1, 1)
        };
        let square = gradient.clone().map(|g| g.powi_scalar(2)).into_iter().reduce(Tensor::add);
        let square = square.expect("two axes") + EPSILON;
        let rest = warped - reference.clone() - along(&flow);
        for _ in 0..ITERATIONS {
            let length = ((rest.clone() + along(&flow)) / square.clone()).clamp(-most, most);
            let step = gradient.clone().map(|g| g * length.clone());
            let fitted = flow.clone() - Tensor::cat(step.to_vec(), 1);
            flow = fitted.clone();
            for _ in 0..DUAL_STEPS {
                let slopes = [3, 2].map(|axis| forward(&flow, axis));
                let size = slopes.clone().map(|s| s.powi_scalar(2)).into_iter().reduce(Tensor::add);
                let norm = size.expect("two axes").sqrt() * (TAU / THETA) + 1.0;
                let mut divergence = flow.zeros_like();
                for ((dual, slope), axis) in dual.iter_mut().zip(slopes).zip([3, 2]) {
                    *dual = (dual.clone() + slope * (TAU / THETA)) / norm.clone();
                    divergence = divergence + backward(dual, axis);
                }
                flow = fitted.clone() + divergence * THETA;
            }
        }
    }
    flow
}

/// Computes central differences, with repeated edges.
fn central(x: &Tensor<4>, axis: usize) -> Tensor<4> {
    let size = x.dims()[axis];
    let mut pads = [(0, 0); 4];
    pads[axis] = (1, 1);
    let padded = x.clone().pad(pads, PadMode::Edge);
    (padded.clone().narrow(axis, 2, size) - padded.narrow(axis, 0, size)) * 0.5
}

/// Computes forward differences, zero at the end.
fn forward(x: &Tensor<4>, axis: usize) -> Tensor<4> {
    let size = x.dims()[axis];
    let mut pads = [(0, 0); 4];
    pads[axis] = (0, 1);
    x.clone().pad(pads, PadMode::Edge).narrow(axis, 1, size) - x.clone()
}

/// Computes backward differences, with zeros before the start.
fn backward(x: &Tensor<4>, axis: usize) -> Tensor<4> {
    let size = x.dims()[axis];
    let mut pads = [(0, 0); 4];
    pads[axis] = (1, 0);
    x.clone() - x.clone().pad(pads, PadMode::Constant(0.0)).narrow(axis, 0, size)
}
