//! Scaling of every pixel's channels to unit size.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::PixelNormBackend;

/// Divides the channels of every pixel by `sqrt(mean square + floor)`.
///
/// # Shapes
/// - x and result: `[images, channels, height, width]`
pub fn pixel_norm(x: Tensor<4>, floor: f32) -> Tensor<4> {
    if is_native(&x) && x.shape().num_elements() > 0 {
        return Tensor::from_dispatch(Dispatch::pixel_norm(x.into_dispatch(), floor));
    }
    let square = x.clone().powi_scalar(2).mean_dim(1) + floor;
    x / square.sqrt()
}

#[cfg(all(test, feature = "flex"))]
mod tests {
    use super::*;
    use crate::with_stock_operations;
    use burn::tensor::{Device, Int};

    /// Results and gradients equal what the composed operations give.
    #[test]
    fn the_operation_is_the_composition() {
        let device = Device::flex().autodiff();
        let shape = [2, 5, 30, 20];
        let values = |scale: f32| {
            let count = i64::try_from(shape.iter().product::<usize>()).expect("few");
            let values = Tensor::<1, Int>::arange(0..count, &device).float();
            (values * scale).sin().reshape(shape)
        };
        let run = || {
            let x = values(0.37).require_grad();
            let result = pixel_norm(x.clone(), 0.05);
            let gradients = (result.clone() * values(0.11)).sum().backward();
            let both = [result.inner(), x.grad(&gradients).expect("a gradient")];
            both.map(|x| x.into_data().try_into_vec::<f32>().expect("numbers")).concat()
        };
        let pairs = run().into_iter().zip(with_stock_operations(run));
        pairs.for_each(|(fused, composed)| assert!((fused - composed).abs() < 1e-5));
    }
}
