//! Scenes whose motion is known, for the tests of what follows it.

use super::config::FOLD;
use super::motion::flow::WindowFlow;
use burn::tensor::{Device, Tensor, TensorData};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

pub(super) const SIDE: usize = 32;
pub(super) const FRAMES: usize = 5;

/// Returns frames of a texture that moves by `speed` pixels a frame, and its flow at half the resolution.
pub(super) fn moving(speed: f32) -> (Tensor<4>, WindowFlow) {
    let device = Device::flex();
    let value = |t: usize, i: usize| {
        let (x, y) = ((i % SIDE) as f32 - speed * t as f32, (i / SIDE) as f32);
        0.2 * (0.5 * x + 0.2 * y).sin() + 0.2 * (0.31 * x - 0.6 * y).cos()
    };
    let frame = |t: usize| (0..SIDE * SIDE).map(move |i| value(t, i));
    let values = (0..FRAMES).flat_map(frame).collect();
    let shape = [FRAMES, 1, SIDE, SIDE];
    let frames = Tensor::from_data(TensorData::new::<f32, _>(values, shape), &device);
    let cells = SIDE / FOLD;
    let plane = |value| Tensor::full([FRAMES - 1, 1, cells, cells], value, &device);
    let of_direction =
        |sign: f32| Tensor::cat(vec![plane(sign * speed / FOLD as f32), plane(0.0)], 1);
    let pairs = Tensor::cat(vec![of_direction(1.0), of_direction(-1.0)], 0);
    (frames, WindowFlow { pairs, scale: FOLD })
}

/// Returns the part far from the edges.
pub(super) fn inner(x: &Tensor<4>) -> Tensor<4> {
    x.clone().narrow(2, 10, 12).narrow(3, 10, 12)
}

/// Returns the mean squared difference far from the edges.
pub(super) fn error(a: &Tensor<4>, b: &Tensor<4>) -> f32 {
    (inner(a) - inner(b)).powi_scalar(2).mean().into_scalar::<f32>()
}

pub(super) fn noise(sigma: f32) -> Tensor<4> {
    let normal = Normal::new(0.0, sigma).unwrap_or_else(|e| panic!("{e}"));
    let values = normal.sample_iter(ChaCha8Rng::seed_from_u64(1));
    let values = values.take(FRAMES * SIDE * SIDE).collect();
    let data = TensorData::new::<f32, _>(values, [FRAMES, 1, SIDE, SIDE]);
    Tensor::from_data(data, &Device::flex())
}

pub(super) fn sigma(value: f32) -> Tensor<4> {
    Tensor::full([FRAMES, 1, 1, 1], value, &Device::flex())
}
