//! Refinement of the flow, without learning: TV-L1 between pre-denoised frames that are merged along the flow
//! so far, or between predicted frames. In single frames, noise hides fractions of a pixel.

use super::flow::{WindowFlow, pairs};
use super::paths::Paths;
use crate::window::merging::averaged;
use burn::tensor::Tensor;
use qudi_kernels::tv_flow;
use qudi_layers::resample::{avg_pool2, upsample2};

/// Levels of the pyramid, from half the resolution on.
const LEVELS: usize = 4;

/// The smallest side of a level, in cells.
const SMALLEST_SIDE: usize = 8;

/// Sigma of the errors of pre-denoised frames, in [0, 1], over the usual sigma of fused frames, in [-1, 1].
const ERROR: f32 = 0.9;

/// Returns the usual sigma of pre-denoised frames in [0, 1] from the one of fused frames in [-1, 1].
pub(in crate::window) fn pre_denoised_sigma(sigma: &Tensor<4>) -> Tensor<4> {
    sigma.clone() * ERROR
}

/// Refines the flow at half the resolution. No gradient passes.
///
/// # Shapes
/// - restored: pre-denoised frames, `[bursts * frames, 1, H, W]` in image units
/// - sigma: of usual errors in [-1, 1], `[bursts * frames, 1, 1, 1]`
pub(in crate::window) fn refined(
    restored: &Tensor<4>,
    sigma: &Tensor<4>,
    flow: &WindowFlow,
    frames: usize,
) -> WindowFlow {
    let merged = averaged(restored, &pre_denoised_sigma(sigma), &Paths::new(flow, frames));
    let pairs = from_coarse_to_fine(avg_pool2(merged), flow.pairs.clone(), frames, LEVELS);
    WindowFlow { pairs, ..*flow }
}

/// Finds the flow between predicted frames, from `flow` at half the resolution on. They hold fine detail, so
/// that the search ends at the whole resolution.
///
/// # Shapes
/// - images: `[bursts * frames, 1, H, W]` in image units
pub(in crate::window) fn flow_between(
    images: Tensor<4>,
    flow: &WindowFlow,
    frames: usize,
) -> WindowFlow {
    let start = upsample2(flow.pairs.clone()) * 2.0;
    let found = from_coarse_to_fine(images, start, frames, LEVELS + 1);
    WindowFlow { pairs: avg_pool2(found) * 0.5, ..*flow }
}

/// Finds the flow of every pair on a pyramid of at most `levels` levels. `start` and the result lie on the
/// grid of the images, in its cells.
fn from_coarse_to_fine(
    images: Tensor<4>,
    mut start: Tensor<4>,
    frames: usize,
    levels: usize,
) -> Tensor<4> {
    let mut images = vec![images];
    while images.len() < levels {
        let finer = &images[images.len() - 1];
        let [.., h, w] = finer.dims();
        if h.min(w) < 2 * SMALLEST_SIDE || !h.is_multiple_of(2) || !w.is_multiple_of(2) {
            break;
        }
        images.push(avg_pool2(finer.clone()));
        start = avg_pool2(start) * 0.5;
    }
    let mut found = start;
    while let Some(image) = images.pop() {
        let (reference, neighbour) = pairs(image, frames);
        found = tv_flow(reference, neighbour, found);
        if !images.is_empty() {
            found = upsample2(found) * 2.0;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    /// From a flow that errs by a quarter of a cell, the motion of a noisy texture is found.
    #[test]
    fn motion_in_noise_is_found() {
        const SIDE: usize = 64;
        const FRAMES: usize = 5;
        let device = Device::flex();
        let value = |t: usize, i: usize| {
            let (x, y) = ((i % SIDE) as f32 - 1.3 * t as f32, (i / SIDE) as f32);
            0.5 + 0.2 * (0.4 * x + 0.1 * y).sin() + 0.2 * (0.21 * x - 0.35 * y).cos()
        };
        let normal = Normal::new(0.0, 0.03f32).unwrap_or_else(|e| panic!("{e}"));
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let pixels = (0..FRAMES).flat_map(|t| (0..SIDE * SIDE).map(move |i| (t, i)));
        let values = pixels.map(|(t, i)| value(t, i) + normal.sample(&mut rng)).collect();
        let data = TensorData::new::<f32, _>(values, [FRAMES, 1, SIDE, SIDE]);
        let frames = Tensor::<4>::from_data(data, &device);
        let cells = SIDE / 2;
        let plane = |value| Tensor::full([FRAMES - 1, 1, cells, cells], value, &device);
        let start = |x| Tensor::cat(vec![plane(x), plane(0.1)], 1);
        let pairs = Tensor::cat(vec![start(0.4), start(-0.4)], 0);
        let sigma = Tensor::full([FRAMES, 1, 1, 1], 0.1, &device);
        let start = WindowFlow { pairs, scale: 2 };
        let refined = refined(&frames, &sigma, &start, FRAMES);
        let between = flow_between(frames, &start, FRAMES);
        for (found, most) in [(refined, 0.12), (between, 0.2)] {
            let middle = found.pairs.narrow(2, 8, 16).narrow(3, 8, 16);
            for (first, expected) in [(0, 0.65), (FRAMES - 1, -0.65)] {
                let of_direction = middle.clone().narrow(0, first, FRAMES - 1);
                for (axis, expected) in [(0, expected), (1, 0.0)] {
                    let error = of_direction.clone().narrow(1, axis, 1) - expected;
                    let error = error.abs().mean().into_scalar::<f32>();
                    assert!(error < most, "axis {axis}: {error} cells from {expected}");
                }
            }
        }
    }
}
