//! The loss of the predicted uncertainty.

use burn::tensor::Tensor;

/// Computes the mean negative log-likelihood of errors under a normal law of standard deviation `sigma`,
/// without its constant (Kendall and Gal 2017, eq. 5). It is least where `sigma` is the size of the errors.
///
/// # Shapes
/// - error, sigma: `[images, 1, height, width]`
/// - output: `[1]`
pub fn gaussian_nll(error: Tensor<4>, sigma: Tensor<4>) -> Tensor<1> {
    let square = (error / sigma.clone()).powi_scalar(2);
    (square * 0.5 + sigma.log()).mean()
}
