//! Group normalisation (Wu and He 2018) with weights that may differ between images, and SiLU, fused into one
//! pass in each direction.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use burn::tensor::activation::silu;
use extension::GroupNormBackend;

/// Constant added to the variance.
pub const EPSILON: f32 = 1e-5;

/// Options of one normalisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Norm {
    /// Number of groups; divides the channels.
    pub groups: usize,
    /// Activation applied after the affine part.
    pub activation: Activation,
}

/// Activation applied after the affine part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// No activation.
    None,
    /// SiLU, `v * sigmoid(v)`.
    Silu,
}

/// Computes `(x - mean) / sqrt(variance + EPSILON) * weight + bias` by group of channels, then the
/// activation.
///
/// # Shapes
/// `x` and result: `[images, channels, height, width]`; `weight`, `bias`: `[rows, channels]`, row `image *
/// rows / images` for every image: one row for all, or one per burst or image.
pub fn group_norm(x: Tensor<4>, weight: Tensor<2>, bias: Tensor<2>, norm: Norm) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let rows = weight.dims()[0];
    assert_eq!(weight.dims(), [rows, channels], "one weight for every channel");
    assert_eq!(bias.dims(), weight.dims(), "as many biases as weights");
    assert_eq!(images % rows, 0, "every row serves as many images");
    assert_eq!(channels % norm.groups, 0, "groups of equal size");
    if is_native(&x) {
        let (x, weight, bias) = (x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch());
        return Tensor::from_dispatch(Dispatch::group_norm_rows(x, weight, bias, norm));
    }
    let grouped = x.reshape([images * norm.groups, channels / norm.groups * height * width]);
    let centred = grouped.clone() - row_means(grouped);
    let variance = row_means(centred.clone().powi_scalar(2));
    let normal = centred / (variance + EPSILON).sqrt();
    let spread = |values: Tensor<2>| {
        let values = values.reshape([rows, 1, channels]).repeat_dim(1, images / rows);
        values.reshape([images, channels, 1, 1])
    };
    let result = normal.reshape([images, channels, height, width]) * spread(weight) + spread(bias);
    match norm.activation {
        Activation::None => result,
        Activation::Silu => silu(result),
    }
}

/// Computes the mean of every row, in two sums: graphics cards are slow at few long rows.
fn row_means(x: Tensor<2>) -> Tensor<2> {
    const MAX_PARTS: usize = 256;
    let [rows, length] = x.dims();
    let parts = (1..=MAX_PARTS).rev().find(|&parts| length.is_multiple_of(parts)).unwrap_or(1);
    let means = x.reshape([rows * parts, length / parts]).mean_dim(1);
    means.reshape([rows, parts]).mean_dim(1)
}
