//! What all frames say of each one, merged along the flows: a mean over the frames that agree, as robust merging
//! does it (Ma et al. 2020, section 5.2), made recursive, so that only neighbours need be aligned.

use super::flow::Flows;
use super::resample::{by_burst, mean_around, smooth};
use super::variance::Variance;
use burn::tensor::Tensor;
use qudi_kernels::warp;

/// Variance that is left of a pixel's where images are smoothed with 5 x 5 binomial weights and averaged over 3 x 3.
const LEFT: f32 = 0.045_23;

/// Differences above this many times what noise explains are held against a frame.
const EXPECTED: f32 = 1.0;

/// How much a difference of once more what noise explains is held against it, in nats.
const SUSPICION: f32 = 0.5;

/// The frames, merged; `[images, 1, H, W]` each.
#[derive(Clone, Debug)]
pub struct Merged {
    /// Linear estimates.
    pub u: Tensor<4>,
    /// Pre-denoised frames.
    pub d: Tensor<4>,
    /// How many frames count, at least 1.
    pub mass: Tensor<4>,
}

/// Merges linear estimates `u` and pre-denoised frames `d`, `[images, 1, H, W]`, along `flows` of scale 1. `smoothed` is
/// [`smooth`] of `u`: its differences, against what `variance` explains, say which frames agree.
///
/// Forwards, the sum of frame `i` is its own value plus `g` times the warped sum of the frame before; backwards likewise. Gradients reach `d` alone.
pub(super) fn merge(
    u: &Tensor<4>,
    smoothed: &Tensor<4>,
    d: &Tensor<4>,
    variance: &Variance,
    flows: &Flows,
    frames: usize,
) -> Merged {
    let [images, _, height, width] = u.dims();
    let bursts = images / frames;
    let own = Tensor::cat(vec![u.clone().detach(), d.clone(), u.ones_like().detach()], 1);
    let smoothed = smoothed.clone().detach();
    let noise = variance.at(smoothed.clone()) * LEFT;
    // Both sweeps run at once: frame i forward beside frame N - 1 - i backward.
    let pair = |forward: &Tensor<4>, backward: &Tensor<4>, i: usize| {
        let frame = |x: &Tensor<4>, i: usize| {
            let [_, c, h, w] = x.dims();
            by_burst(x.clone(), frames).narrow(1, i, 1).reshape([bursts, c, h, w])
        };
        Tensor::cat(vec![frame(forward, i), frame(backward, frames - 1 - i)], 0)
    };
    let (to_prev, to_next) = (flows.to_prev.clone().detach(), flows.to_next.clone().detach());
    let mut sums: Option<Tensor<4>> = None;
    let (mut forward, mut backward) = (Vec::new(), Vec::new());
    for i in 0..frames {
        let own = pair(&own, &own, i);
        let sum = match sums {
            None => own,
            Some(sums) => {
                let moved = warp(sums, pair(&to_prev, &to_next, i));
                let known = moved.clone().detach();
                let mass = known.clone().narrow(1, 2, 1);
                let before = smooth(known.narrow(1, 0, 1) / mass.clone());
                let difference = mean_around(pair(&smoothed, &smoothed, i) - before, 1);
                let noise = pair(&noise, &noise, i) * (mass.recip() + 1.0);
                let excess = mean_around(difference.powi_scalar(2), 2) / noise - EXPECTED;
                let agreement = (excess.clamp_min(0.0) * -SUSPICION).exp();
                own + moved * agreement
            }
        };
        forward.push(sum.clone().narrow(0, 0, bursts));
        backward.push(sum.clone().narrow(0, bursts, bursts));
        sums = Some(sum);
    }
    backward.reverse();
    let joined =
        |list: Vec<Tensor<4>>| Tensor::stack::<5>(list, 1).reshape([images, 3, height, width]);
    // Every frame is in both sums.
    let sum = joined(forward) + joined(backward) - own;
    let [u, d, mass] = [0, 1, 2].map(|place| sum.clone().narrow(1, place, 1));
    let mass = mass.detach();
    Merged { u: u.detach() / mass.clone(), d: d / mass.clone(), mass }
}
