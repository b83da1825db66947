//! Warping where nothing is beyond the borders.

use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_kernels::warp;

/// Samples `x` at `(column + flow_x, row + flow_y)`: bilinear, zero outside (`grid_sample` with
/// `align_corners` and padding of zeros).
///
/// # Shapes
/// - x, result: `[images, channels, height, width]`
/// - flow: `[images, 2, height, width]`, x before y, in pixels
pub fn warp_zeros(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = x.dims();
    let around = [(0, 0), (0, 0), (1, 1), (1, 1)];
    // A border of zeros, to which all coordinates beyond it are clamped.
    let padded = x.pad(around, PadMode::Constant(0.0));
    let flow = flow.pad(around, PadMode::Constant(0.0));
    warp(padded, flow).narrow(2, 1, height).narrow(3, 1, width)
}

/// Warps as [`warp_zeros`], with zero wherever any part comes from outside.
///
/// # Shapes
/// - as of [`warp_zeros`]
pub fn masked_warp(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    const MIN_WEIGHT: f32 = 0.9999;
    let ones = x.clone().narrow(1, 0, 1).ones_like();
    let inside = warp_zeros(ones, flow.clone()).greater_equal_elem(MIN_WEIGHT).float();
    warp_zeros(x, flow) * inside
}

/// Returns one flow, or one factor of flows, for all pixels, `[1, 2, 1, 1]`: x before y.
pub fn same_flow(flow: [f32; 2], device: &Device) -> Tensor<4> {
    Tensor::from_data(TensorData::new(flow.to_vec(), [1, 2, 1, 1]), device)
}
