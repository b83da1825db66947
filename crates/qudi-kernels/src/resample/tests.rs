use super::{Resampling, resampled};
use burn::tensor::{Device, Tensor, TensorData};

/// Creates reproducible numbers in [-1, 1).
fn numbers(seed: u32, shape: [usize; 4], device: &Device) -> Tensor<4> {
    let mut state = seed.wrapping_mul(2_654_435_769) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as f32 / 2f32.powi(31) - 1.0
    };
    let values = (0..shape.iter().product()).map(|_| next()).collect();
    Tensor::from_data(TensorData::new::<f32, _>(values, shape), device)
}

/// Every map and the map of its gradients agree: `<map(x), y> = <x, transposed(y)>`.
#[test]
fn gradients_are_the_transposed_map() {
    use Resampling::{Downsample, Pool, Shuffle, Unpool, Unshuffle, Upsample};
    let device = Device::flex().autodiff();
    for how in [Unshuffle(2), Shuffle(2), Unshuffle(4), Pool, Unpool, Upsample, Downsample] {
        let x = numbers(1, [3, 4, 8, 12], &device).require_grad();
        let result = resampled(&x, how).expect("flex has all maps");
        let weights = numbers(2, result.dims(), &device);
        let gradients = (result.clone() * weights).sum().backward();
        let gradient = x.grad(&gradients).expect("a gradient");
        let left = (gradient * x.clone().inner()).sum().into_scalar::<f32>();
        let right = (result * numbers(2, how.shape(x.dims()).expect("a shape"), &device)).sum();
        let right = right.into_scalar::<f32>();
        assert!((left - right).abs() < 1e-3, "{how:?}: {left} and {right}");
    }
}

/// Sizes that do not divide evenly, and other kinds of numbers, are left to Burn's operations.
#[test]
fn odd_sizes_are_composed() {
    let device = Device::flex();
    let odd = numbers(3, [1, 3, 5, 6], &device);
    assert!(resampled(&odd, Resampling::Pool).is_none());
    assert!(resampled(&odd, Resampling::Unshuffle(2)).is_none());
    assert!(resampled(&odd, Resampling::Shuffle(2)).is_none());
    assert!(resampled(&odd, Resampling::Upsample).is_some());
    assert!(crate::with_stock_operations(|| resampled(&odd, Resampling::Upsample)).is_none());
}
