//! Conversion between images in memory and tensors.

use burn::tensor::{Device, Gradients, Tensor, TensorData};
use qudi_core::{Error, Result, Size};

/// Converts images to a tensor, `[images, 1, height, width]`. `values` holds whole images, row-major.
pub fn to_tensor(values: Vec<f32>, size: Size, device: &Device) -> Tensor<4> {
    let images = values.len() / size.pixels();
    Tensor::from_data(TensorData::new(values, [images, 1, size.height, size.width]), device)
}

/// Reads the values of a tensor, row-major.
///
/// # Errors
/// [`Error::Request`] if the device fails; kernels report their errors only here.
pub fn read<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>> {
    let device = format!("{:?}", tensor.device());
    let failed = |problem: String| {
        Error::request(
            format!("the device failed: {problem}"),
            device.clone(),
            "try a smaller `tile`, `qudi selftest`, or the device cpu",
        )
    };
    let data = tensor.try_into_data().map_err(|e| failed(e.to_string()))?;
    data.try_into_vec::<f32>().map_err(|e| failed(e.to_string()))
}

/// Returns the gradient of `x`, or zeros if there is none.
pub fn gradient_of<const D: usize>(x: &Tensor<D>, gradients: &Gradients) -> Tensor<D> {
    x.grad(gradients).unwrap_or_else(|| x.clone().inner().zeros_like())
}

/// Returns the sum of `x * gradient`. Its own gradient with respect to `x` is `gradient`, which continues
/// backpropagation through `x`.
pub fn product<const D: usize>(x: Tensor<D>, gradient: Tensor<D>) -> Tensor<1> {
    (x * Tensor::from_inner(gradient)).sum()
}
