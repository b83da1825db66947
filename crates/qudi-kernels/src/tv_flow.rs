//! Optical flow that minimizes total variation and absolute differences (TV-L1), without gradient.
//!
//! Zach, Pock and Bischof, "A duality based approach for realtime TV-L1 optical flow", DAGM 2007.

mod composed;
#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::TvFlowBackend;

/// Weight of absolute differences against the total variation of the flow in pixels, for images in [0, 1]:
/// `lambda` of the paper.
const LAMBDA: f32 = 8.0;

/// How closely the two halves of the problem are tied: `theta` of the paper.
const THETA: f32 = 0.3;

/// Step of the dual variables: `tau` of the paper.
const TAU: f32 = 0.25;

/// Times that the neighbour is warped and differences are linearized.
const WARPS: usize = 4;

/// Iterations after each warp.
const ITERATIONS: usize = 8;

/// Steps of the dual variables in each iteration.
const DUAL_STEPS: usize = 2;

/// Keeps divisions by squared gradients finite.
const EPSILON: f32 = 1e-9;

/// Refines the flow of one level, `start`.
///
/// # Shapes
/// - reference, neighbour: `[pairs, 1, height, width]` in image units
/// - start, result: `[pairs, 2, height, width]`, x before y, in pixels
pub fn tv_flow(reference: Tensor<4>, neighbour: Tensor<4>, start: Tensor<4>) -> Tensor<4> {
    let [pairs, _, height, width] = reference.dims();
    assert_eq!(neighbour.dims(), reference.dims(), "a neighbour for every frame");
    assert_eq!(start.dims(), [pairs, 2, height, width], "one flow for every pixel");
    if [&reference, &neighbour, &start].iter().any(|x| x.is_autodiff()) {
        let [reference, neighbour, start] = [reference, neighbour, start].map(Tensor::inner);
        return Tensor::from_inner(tv_flow(reference, neighbour, start));
    }
    if is_native(&reference) && reference.shape().num_elements() > 0 {
        let [reference, neighbour, start] =
            [reference, neighbour, start].map(Tensor::into_dispatch);
        return Tensor::from_dispatch(Dispatch::tv_flow(reference, neighbour, start));
    }
    composed::tv_flow(&reference, &neighbour, start)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    /// Returns a texture that has moved by a shift and grows by a share.
    fn texture(shift: [f32; 2], growth: f32) -> Tensor<4> {
        const SIZE: usize = 40;
        let value = |x: f32, y: f32| {
            let (x, y) = ((x - shift[0]) / (1.0 + growth), (y - shift[1]) / (1.0 + growth));
            0.5 + 0.2 * (0.5 * x + 0.2 * y).sin() + 0.2 * (0.31 * x - 0.6 * y).cos()
        };
        let values = (0..SIZE * SIZE).map(|i| value((i % SIZE) as f32, (i / SIZE) as f32));
        Tensor::from_data(TensorData::new(values.collect(), [1, 1, SIZE, SIZE]), &Device::flex())
    }

    fn flow(reference: &Tensor<4>, neighbour: &Tensor<4>) -> Vec<f32> {
        let [pairs, _, h, w] = reference.dims();
        let start = Tensor::zeros([pairs, 2, h, w], &reference.device());
        let flow = tv_flow(reference.clone(), neighbour.clone(), start);
        flow.into_data().try_to_vec().unwrap_or_else(|e| panic!("{e:?}"))
    }

    #[test]
    fn moved_and_growing_textures_are_found() {
        let still = texture([0.0; 2], 0.0);
        let at = |flow: &[f32], axis: usize, x: usize, y: usize| flow[axis * 1600 + y * 40 + x];
        let moved = flow(&still, &texture([0.7, -1.2], 0.0));
        let [x, y] = [0, 1].map(|axis| at(&moved, axis, 20, 20));
        assert!((x - 0.7).abs() < 0.05 && (y + 1.2).abs() < 0.05, "{x}, {y}");
        let grown = flow(&still, &texture([0.0; 2], 0.05));
        for (x, y) in [(10, 10), (30, 12), (20, 28)] {
            let [dx, dy] = [0, 1].map(|axis| at(&grown, axis, x, y));
            let [right, down] = [x, y].map(|place| 0.05 * place as f32);
            assert!((dx - right).abs() < 0.15 && (dy - down).abs() < 0.15, "{dx}, {dy}");
        }
        let none = flow(&still, &still);
        assert!(none.iter().all(|v| v.abs() < 1e-5), "what stands still moves");
    }

    /// One operation computes what Burn's do.
    #[test]
    fn flow_is_the_composed_one() {
        let pairs = |a, b| Tensor::cat(vec![a, b], 0);
        let reference = pairs(texture([0.0; 2], 0.0), texture([1.0, 0.5], 0.02));
        let neighbour = pairs(texture([0.8, 0.3], 0.01), texture([0.2, 0.9], 0.0));
        let start = Tensor::ones([2, 2, 40, 40], &Device::flex()) * 0.2;
        let composed = composed::tv_flow(&reference, &neighbour, start.clone());
        let difference = tv_flow(reference, neighbour, start) - composed;
        let most = difference.abs().max().into_scalar::<f32>();
        assert!(most < 1e-3, "differs by {most} pixels");
    }
}
