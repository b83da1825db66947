//! Losses of several networks.

use burn::tensor::Tensor;

/// Computes Charbonnier's loss: the mean of `sqrt(d^2 + 1e-6)`, `[1]`.
pub fn charbonnier<const D: usize>(x: Tensor<D>, truth: Tensor<D>) -> Tensor<1> {
    ((x - truth).powi_scalar(2) + 1e-6).sqrt().mean()
}

/// Computes the mean absolute error, and half of the mean absolute error of the derivatives by Sobel along
/// rows and columns, borders left out, `[1]`.
///
/// # Shapes
/// - x, truth: `[images, 1, height, width]`
pub fn gradient_loss(x: Tensor<4>, truth: Tensor<4>) -> Tensor<1> {
    let error = x - truth;
    // The derivatives of a difference are the differences of derivatives.
    let slopes = [2, 3].map(|axis| {
        let across = 5 - axis;
        let [along, beside] = [error.dims()[axis] - 2, error.dims()[across] - 2];
        let difference =
            error.clone().narrow(axis, 0, along) - error.clone().narrow(axis, 2, along);
        let part = |from: usize| difference.clone().narrow(across, from, beside);
        (part(0) + part(1) * 2.0 + part(2)).abs().mean()
    });
    let [rows, columns] = slopes;
    error.abs().mean() + (rows + columns) * 0.5
}
