//! The squared error, linear far from zero (pseudo-Huber; Hartley and Zisserman 2004, section A6.8).

use burn::tensor::Tensor;

/// The error from which on the loss grows linearly: saturated pixels, whose errors are many times the usual
/// one, would decide otherwise.
const LINEAR_FROM: f32 = 4.0;

/// Computes `mean 2 d^2 (sqrt(1 + (e / d)^2) - 1)` of errors in units of their usual size: about `e^2` where
/// it is small.
///
/// # Shapes
/// - error: `[images, 1, height, width]`
/// - output: `[1]`
pub(crate) fn robust_square(error: Tensor<4>) -> Tensor<1> {
    let relative = (error / LINEAR_FROM).powi_scalar(2);
    (((relative + 1.0).sqrt() - 1.0) * (2.0 * LINEAR_FROM * LINEAR_FROM)).mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn small_errors_count_squared_and_large_ones_linearly() {
        let of = |error: f32| {
            let error = Tensor::<4>::full([1, 1, 2, 2], error, &Device::flex());
            robust_square(error).into_scalar::<f32>()
        };
        assert!((of(0.1) / 0.01 - 1.0).abs() < 1e-3);
        assert!((of(-1.0) - 1.0).abs() < 0.02);
        assert!((of(400.0) / of(200.0) - 2.0).abs() < 0.05);
    }
}
