//! Registration that needs no training: steps of Lucas and Kanade (1981) under a prior.

use burn::tensor::Tensor;
use qudi_kernels::warp;
use qudi_layers::resample::{differences, mean_around};

/// Weight of the prior, in variances of a pixel's noise: where that hides what moves, a motion stays as it
/// was. Found on the validation clips (docs/notes/network/start.md).
const PRIOR: f32 = 0.005;

/// Radius of the window that moves as one, in cells.
const WINDOW: usize = 4;

/// Radius over which found motions are averaged, in cells.
const AVERAGE: usize = 2;

const STEPS: usize = 3;

/// Farthest motion found on one level, in cells.
const FARTHEST: f32 = 3.0;

/// How much further than `start` to look into `neighbour` for what `reference` shows, in cells: `[pairs, 2,
/// h, w]`.
///
/// `reference` and `neighbour`: `[pairs, 1, h, w]`; `start`: `[pairs, 2, h, w]`; `variance` that of their
/// pixels' noise, `[pairs, 1, 1, 1]`. Every cell's motion minimises squared differences over its window plus
/// the prior, linearised around the last estimate. No gradient flows through it.
pub(super) fn lucas_kanade(
    reference: Tensor<4>,
    neighbour: Tensor<4>,
    start: Tensor<4>,
    variance: Tensor<4>,
) -> Tensor<4> {
    let (reference, neighbour, start) = (reference.detach(), neighbour.detach(), start.detach());
    let prior = variance.detach() * PRIOR;
    let mut motion = start.zeros_like();
    for _ in 0..STEPS {
        let warped = warp(neighbour.clone(), start.clone() + motion.clone());
        let (across, down) = differences((reference.clone() + warped.clone()) * 0.5);
        let error = reference.clone() - warped;
        // What the estimate so far explains is part of the equations: the prior holds the whole motion.
        let [x, y] = [0, 1].map(|axis| motion.clone().narrow(1, axis, 1));
        let left = error + across.clone() * x + down.clone() * y;
        let products = Tensor::cat(
            vec![
                across.clone() * across.clone(),
                across.clone() * down.clone(),
                down.clone() * down.clone(),
                across * left.clone(),
                down * left,
            ],
            1,
        );
        let means = mean_around(products, WINDOW);
        let [xx, xy, yy, xe, ye] = [0, 1, 2, 3, 4].map(|place| means.clone().narrow(1, place, 1));
        let (xx, yy) = (xx + prior.clone(), yy + prior.clone());
        let determinant = xx.clone() * yy.clone() - xy.clone() * xy.clone();
        let x = (yy * xe.clone() - xy.clone() * ye.clone()) / determinant.clone();
        let y = (xx * ye - xy * xe) / determinant;
        motion = Tensor::cat(vec![x, y], 1).clamp(-FARTHEST, FARTHEST);
    }
    mean_around(motion, AVERAGE)
}
