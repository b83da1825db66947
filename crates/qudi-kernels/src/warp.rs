//! Backward warping by optical flow.

pub(crate) mod cubic;
#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::{is_native, is_recorded};
use burn::backend::Dispatch;
use burn::tensor::ops::{GridSampleOptions, GridSamplePaddingMode, InterpolateMode};
use burn::tensor::{Device, Tensor, TensorData};
use extension::WarpBackend;

/// How values between pixels are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(unreachable_pub)] // part of public traits
pub enum Interpolation {
    /// From four pixels.
    Bilinear,
    /// From sixteen, by cubic convolution.
    Cubic,
}

/// Samples `x` at `(column + flow_x, row + flow_y)` with bilinear interpolation. Coordinates are clamped to
/// the grid (`grid_sample` with `align_corners` and border padding). The flow gets no gradient where a
/// coordinate was clamped.
///
/// # Shapes
/// `x` and result: `[images, channels, height, width]`; `flow`: `[images, 2, height, width]`, x before y, in
/// pixels.
pub fn warp(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    let [images, _, height, width] = x.dims();
    assert_eq!(flow.dims(), [images, 2, height, width], "one flow for every pixel");
    if is_native(&x) || is_recorded(&x) {
        let (x, flow) = (x.into_dispatch(), flow.into_dispatch());
        return Tensor::from_dispatch(Dispatch::warp(x, flow, Interpolation::Bilinear));
    }
    let device = flow.device();
    let pixels = flow.permute([0, 2, 3, 1]) + positions(height, width, &device);
    // grid_sample expects [-1, 1] from the first pixel's centre to the last one's.
    let scale = [2.0 / (width.max(2) - 1) as f32, 2.0 / (height.max(2) - 1) as f32];
    let scale = Tensor::<1>::from_floats(scale, &device).reshape([1, 1, 1, 2]);
    let options = GridSampleOptions::new(InterpolateMode::Bilinear)
        .with_padding_mode(GridSamplePaddingMode::Border)
        .with_align_corners(true);
    x.grid_sample_2d(pixels * scale - 1.0, options)
}

/// Samples `x` as [`warp`] does, but with cubic convolution (Keys 1981, `a = -0.75` as in PyTorch), which
/// keeps fine detail. Pixels beyond the edge are those at the edge. The flow gets no gradient.
///
/// # Shapes
/// As for [`warp`].
pub fn warp_cubic(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    let [images, _, height, width] = x.dims();
    assert_eq!(flow.dims(), [images, 2, height, width], "one flow for every pixel");
    let flow = flow.detach();
    if is_native(&x) || is_recorded(&x) {
        let (x, flow) = (x.into_dispatch(), flow.into_dispatch());
        return Tensor::from_dispatch(Dispatch::warp(x, flow, Interpolation::Cubic));
    }
    cubic::composed(x, flow)
}

/// Returns the column and row of every pixel, `[1, height, width, 2]`.
fn positions(height: usize, width: usize, device: &Device) -> Tensor<4> {
    let places = (0..height).flat_map(|y| (0..width).flat_map(move |x| [x as f32, y as f32]));
    Tensor::from_data(TensorData::new(places.collect(), [1, height, width, 2]), device)
}
