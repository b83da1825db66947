//! Soft block matching: motion without learning, as a start for the flow.

use burn::tensor::Tensor;
use burn::tensor::activation::softmax;
use burn::tensor::module::unfold4d;
use burn::tensor::ops::{PadMode, UnfoldOptions};
use qudi_kernels::block_differences;
use qudi_layers::resample::mean_around;

/// How sharply the best match wins.
const SHARPNESS: f32 = 20.0;

/// Squared difference, in image units, that noise alone makes between pre-denoised frames. Without it, flat
/// parts jitter by pixels.
const NOISE_FLOOR: f32 = 0.008;

/// The share of the mean difference that the floor gains: textures differ more everywhere.
const MEAN_SHARE: f32 = 0.15;

/// Radius of the means over which a block is compared, in cells.
const BLOCK_RADIUS: usize = 4;

/// Estimates the motion of `reference` towards `neighbour` within `radius` cells: the expected displacement
/// under a softmax of block differences and a prior towards none. No gradient flows through it.
///
/// # Shapes
/// - reference, neighbour: `[pairs, 1, h, w]` in image units; `pairs_of_burst` in a row are of one burst and
///   direction
/// - output: `[pairs, 2, h, w]`, x before y, in cells
pub(super) fn soft_match(
    reference: Tensor<4>,
    neighbour: Tensor<4>,
    radius: usize,
    pairs_of_burst: usize,
) -> Tensor<4> {
    if reference.is_autodiff() {
        let (reference, neighbour) = (reference.inner(), neighbour.inner());
        return Tensor::from_inner(soft_match(reference, neighbour, radius, pairs_of_burst));
    }
    let side = 2 * radius + 1;
    let difference = block_differences(&reference, &neighbour, radius)
        .unwrap_or_else(|| composed_differences(&reference, neighbour, radius));
    let difference = mean_of_pairs_around(difference, pairs_of_burst);
    let floor = difference.clone().mean_dim(1) * MEAN_SHARE + NOISE_FLOOR;
    let offset = |at: usize| at as f32 - radius as f32;
    let displacements = (0..side * side).map(|k| [offset(k % side), offset(k / side)]);
    let displacements: Vec<[f32; 2]> = displacements.collect();
    let plane = |f: &dyn Fn(&[f32; 2]) -> f32| {
        let values: Vec<f32> = displacements.iter().map(f).collect();
        Tensor::<1>::from_floats(values.as_slice(), &difference.device()).reshape([
            1,
            side * side,
            1,
            1,
        ])
    };
    let prior = plane(&|[x, y]| x * x + y * y);
    let weights = softmax(difference.clone() * -SHARPNESS / floor - prior, 1);
    let expected = |axis: usize| (weights.clone() * plane(&move |v| v[axis])).sum_dim(1);
    Tensor::cat(vec![expected(0), expected(1)], 1)
}

/// Computes [`block_differences`] by Burn's operations.
fn composed_differences(reference: &Tensor<4>, neighbour: Tensor<4>, radius: usize) -> Tensor<4> {
    let [pairs, _, h, w] = reference.dims();
    let side = 2 * radius + 1;
    let padded = neighbour.pad((radius, radius, radius, radius), PadMode::Edge);
    let options = UnfoldOptions::new([1, 1], [0, 0], [1, 1]);
    let candidates = unfold4d(padded, [side, side], options).reshape([pairs, side * side, h, w]);
    mean_around((candidates - reference.clone()).powi_scalar(2), BLOCK_RADIUS)
}

/// Averages the differences of every pair of frames with the differences of the pairs before and after, whose
/// motion is about the same and whose noise is not.
fn mean_of_pairs_around(difference: Tensor<4>, pairs_of_burst: usize) -> Tensor<4> {
    let [pairs, candidates, h, w] = difference.dims();
    let whole = difference.reshape([pairs / pairs_of_burst, pairs_of_burst, candidates * h * w]);
    let mean = |pair: usize| {
        let first = pair.saturating_sub(1);
        let last = (pair + 1).min(pairs_of_burst - 1);
        whole.clone().narrow(1, first, last + 1 - first).mean_dim(1)
    };
    Tensor::cat((0..pairs_of_burst).map(mean).collect(), 1).reshape([pairs, candidates, h, w])
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use qudi_layers::tensor::read;

    /// A texture moves two cells to the right and one up; far from the border it is found.
    #[test]
    fn a_moved_texture_is_found_and_a_flat_one_stays() {
        let device = Device::flex();
        let texture = |x: f32, y: f32| {
            0.5 + 0.25 * (0.9 * x + 0.3 * y).sin() + 0.2 * (0.4 * x - 1.1 * y).cos()
        };
        let image = |f: &dyn Fn(f32, f32) -> f32| {
            let values = (0..32 * 32).map(|i| f((i % 32) as f32, (i / 32) as f32)).collect();
            Tensor::from_data(TensorData::new::<f32, _>(values, [1, 1, 32, 32]), &device)
        };
        let at = |flow: &[f32], axis: usize| flow[axis * 32 * 32 + 16 * 32 + 16];
        let (reference, moved) = (image(&texture), image(&|x, y| texture(x - 2.0, y + 1.0)));
        let flow = read(soft_match(reference, moved, 3, 1)).unwrap_or_else(|e| panic!("{e}"));
        assert!((at(&flow, 0) - 2.0).abs() < 0.3, "{}", at(&flow, 0));
        assert!((at(&flow, 1) + 1.0).abs() < 0.3, "{}", at(&flow, 1));
        let flat = image(&|_, _| 0.5);
        let flow = read(soft_match(flat.clone(), flat, 3, 1)).unwrap_or_else(|e| panic!("{e}"));
        assert!(at(&flow, 0).abs() < 1e-4 && at(&flow, 1).abs() < 1e-4);
    }

    /// One operation computes what Burn's do, bit for bit.
    #[test]
    fn differences_are_the_composed_ones() {
        let image = |frequency: f32| {
            let values: Vec<f32> = (0..3 * 10 * 17).map(|i| (i as f32 * frequency).sin()).collect();
            let shape = [3, 1, 10, 17];
            Tensor::<4>::from_data(TensorData::new(values, shape), &Device::flex())
        };
        let (reference, neighbour) = (image(0.37), image(0.41));
        let values = |x| read(x).unwrap_or_else(|e| panic!("{e}"));
        let native = block_differences(&reference, &neighbour, 3).expect("flex has it");
        assert_eq!(values(native), values(composed_differences(&reference, neighbour, 3)));
    }

    /// Pairs are averaged with their neighbours of the same burst only.
    #[test]
    fn pairs_of_other_bursts_are_left_alone() {
        let values: Vec<f32> = vec![1.0, 2.0, 6.0, 30.0, 60.0, 30.0];
        let differences = Tensor::<1>::from_floats(values.as_slice(), &Device::flex());
        let mean = mean_of_pairs_around(differences.reshape([6, 1, 1, 1]), 3);
        let mean = read(mean).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(mean, [1.5, 3.0, 4.0, 45.0, 40.0, 45.0]);
    }
}
