//! The logarithm of the mean squared error, image by image: PSNR as a loss. A dark image, whose error is
//! large whatever the network does, weighs as much as a bright one.

use burn::tensor::Tensor;

/// Added to the mean square, in units of the usual error: below a tenth of it nothing more is won.
const FLOOR: f32 = 0.01;

/// Computes the mean over images of `ln(mean e^2 + 0.01)`.
///
/// # Shapes
/// - error: `[images, 1, height, width]`, in units of its usual size
/// - output: `[1]`
pub(crate) fn log_mean_square(error: Tensor<4>) -> Tensor<1> {
    let [images, _, height, width] = error.dims();
    let squares = error.powi_scalar(2).reshape([images, height * width]).mean_dim(1);
    (squares + FLOOR).log().mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    /// Halving the error of one image lowers the loss by as much, whatever the other images' errors.
    #[test]
    fn every_image_weighs_the_same() {
        let of = |errors: [f32; 2]| {
            let error = errors.map(|e| Tensor::<4>::full([1, 1, 3, 2], e, &Device::flex()));
            log_mean_square(Tensor::cat(error.to_vec(), 0)).into_scalar::<f32>()
        };
        let half = 2.0f32.ln();
        assert!((of([8.0, 3.0]) - of([4.0, 3.0]) - half).abs() < 2e-3);
        assert!((of([800.0, 8.0]) - of([800.0, 4.0]) - half).abs() < 2e-3);
        assert!((of([0.0, 0.0]) - FLOOR.ln()).abs() < 1e-4);
    }
}
