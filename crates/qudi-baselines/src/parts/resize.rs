//! Bilinear resizing to any size, as products with matrices: it has a gradient on every device.

use burn::tensor::{Device, Tensor, TensorData};

/// What of the two grids falls together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Corners {
    /// The outer edges of the corner pixels.
    Edges,
    /// The centres of the corner pixels.
    Centres,
}

/// Resizes an image, bilinear between pixels, borders repeated, without a filter before it.
///
/// # Shapes
/// - x: `[images, channels, height, width]`
/// - result: `[images, channels, size[0], size[1]]`
pub fn resize(x: Tensor<4>, size: [usize; 2], corners: Corners) -> Tensor<4> {
    let [_, _, height, width] = x.dims();
    if [height, width] == size {
        return x;
    }
    let rows = matrix(height, size[0], corners, &x.device());
    let columns = matrix(width, size[1], corners, &x.device());
    rows.matmul(x).matmul(columns.transpose())
}

/// Resizes to a quarter, bicubic (a = -3/4), without a filter before it: four taps on every four pixels.
///
/// # Shapes
/// - x: `[images, channels, 4 * height, 4 * width]`
/// - result: `[images, channels, height, width]`
pub fn quarter(x: Tensor<4>) -> Tensor<4> {
    const TAPS: [f32; 4] = [-3.0 / 32.0, 19.0 / 32.0, 19.0 / 32.0, -3.0 / 32.0];
    let [_, _, height, width] = x.dims();
    let matrix = |old: usize| {
        let mut values = vec![0.0f32; old / 4 * old];
        for (i, row) in values.chunks_exact_mut(old).enumerate() {
            row[4 * i..4 * i + 4].copy_from_slice(&TAPS);
        }
        Tensor::<4>::from_data(TensorData::new(values, [1, 1, old / 4, old]), &x.device())
    };
    let (rows, columns) = (matrix(height), matrix(width));
    rows.matmul(x).matmul(columns.transpose())
}

/// Returns the weight of every old pixel in every new one, `[1, 1, new, old]`.
fn matrix(old: usize, new: usize, corners: Corners, device: &Device) -> Tensor<4> {
    let mut values = vec![0.0f32; old * new];
    for (i, row) in values.chunks_exact_mut(old).enumerate() {
        let place = match corners {
            Corners::Edges => (i as f64 + 0.5) * old as f64 / new as f64 - 0.5,
            Corners::Centres => i as f64 * (old - 1) as f64 / (new.max(2) - 1) as f64,
        };
        let place = place.clamp(0.0, (old - 1) as f64);
        let (first, part) = (place.floor() as usize, place - place.floor());
        row[first] += (1.0 - part) as f32;
        row[(first + 1).min(old - 1)] += part as f32;
    }
    Tensor::from_data(TensorData::new(values, [1, 1, new, old]), device)
}
