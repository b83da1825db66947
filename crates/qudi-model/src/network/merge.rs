//! What all frames say of each one: a mean over the frames that agree, as robust merging of bursts does it (Ma et
//! al. 2020, section 5.2), nearest frames first.

use super::flow::Flows;
use super::resample::{by_burst, mean_around, rescale_flow, smooth};
use burn::tensor::Tensor;
use qudi_kernels::warp;

/// Frames on either side that are merged: flows to farther ones have added up too many errors.
const REACH: usize = 5;

/// Variance that is left of a pixel's where images are smoothed with 5 x 5 binomial weights and averaged over 3 x 3.
const LEFT: f32 = 0.045_23;

/// Differences above this many times what noise explains are held against a frame.
const EXPECTED: f32 = 1.0;

/// How much a difference of once more what noise explains is held against it, in nats.
const SUSPICION: f32 = 1.0;

/// The frames, merged; `[images, 1, H, W]` each.
pub(super) struct Merged {
    /// Linear estimates.
    pub u: Tensor<4>,
    /// Pre-denoised frames.
    pub d: Tensor<4>,
    /// How many frames count, at least 1.
    pub mass: Tensor<4>,
}

/// Merges linear estimates `u` and pre-denoised frames `d` along `flows`. How an estimate differs from those merged so far,
/// against what the `variance` of their noise explains, says which frames agree. `u`, `d`, `variance`: `[images, 1, H, W]`.
///
/// Flows to farther frames are composed of those between neighbours, so that every frame is interpolated once. Gradients
/// reach `d` alone.
pub(super) fn merge(
    u: &Tensor<4>,
    d: &Tensor<4>,
    variance: &Tensor<4>,
    flows: &Flows,
    frames: usize,
) -> Merged {
    let [images, _, height, width] = u.dims();
    let bursts = images / frames;
    let u = u.clone().detach();
    let noise = variance.clone() * LEFT;
    let own = Tensor::cat(vec![u.clone(), d.clone(), u.ones_like()], 1);
    let (next, prev) = (flows.to_next.clone().detach(), flows.to_prev.clone().detach());
    let mut sum = own.clone();
    let mut reach: Option<Tensor<4>> = None;
    for k in 1..frames.min(REACH + 1) {
        let count = frames - k;
        // `count` frames of every burst from one of the first; first for the frames ahead, then for those behind.
        let part = |x: &Tensor<4>, first: usize| {
            let [_, c, h, w] = x.dims();
            let frames = x.dims()[0] / bursts;
            by_burst(x.clone(), frames).narrow(1, first, count).reshape([bursts * count, c, h, w])
        };
        let both = |ahead: Tensor<4>, behind: Tensor<4>| Tensor::cat(vec![ahead, behind], 0);
        // From a frame to the one k farther: to the one k - 1 farther, and on from there.
        let last = both(part(&next, k - 1), part(&prev, 1));
        let flow = match reach {
            None => last,
            Some(reach) => {
                let [ahead, behind] = halves(&reach);
                let before = both(part(&ahead, 0), part(&behind, 1));
                before.clone() + warp(last, before)
            }
        };
        reach = Some(flow.clone());
        let moved = warp(both(part(&own, k), part(&own, 0)), rescale_flow(flow, flows.scale, 1));
        let known = sum.clone().detach();
        let mass = known.clone().narrow(1, 2, 1);
        let merged = smooth(known.narrow(1, 0, 1) / mass.clone());
        let here = |x: &Tensor<4>| both(part(x, 0), part(x, k));
        let there = smooth(moved.clone().detach().narrow(1, 0, 1));
        let difference = mean_around(there - here(&merged), 1);
        let noise = here(&(noise.clone() * (mass.recip() + 1.0)));
        let excess = mean_around(difference.powi_scalar(2), 2) / noise - EXPECTED;
        let votes = moved * (excess.clamp_min(0.0) * -SUSPICION).exp();
        let [ahead, behind] = halves(&votes);
        let none = Tensor::zeros([bursts, k, 3, height, width], &own.device());
        let ahead = Tensor::cat(vec![by_burst(ahead, count), none.clone()], 1);
        let behind = Tensor::cat(vec![none, by_burst(behind, count)], 1);
        sum = sum + (ahead + behind).reshape([images, 3, height, width]);
    }
    let [u, d, mass] = [0, 1, 2].map(|place| sum.clone().narrow(1, place, 1));
    let mass = mass.detach();
    Merged { u: u.detach() / mass.clone(), d: d / mass.clone(), mass }
}

/// The first and the second half of the images.
fn halves(x: &Tensor<4>) -> [Tensor<4>; 2] {
    let half = x.dims()[0] / 2;
    [0, half].map(|first| x.clone().narrow(0, first, half))
}
