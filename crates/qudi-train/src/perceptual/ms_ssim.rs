//! MS-SSIM (Wang, Simoncelli and Bovik 2003, "Multi-scale structural similarity for image quality assessment").

use super::scales;
use burn::tensor::{Device, Tensor};
use qudi_kernels::conv::{Options, conv_2d};
use qudi_model::network::halve;

/// Weights of the scales, finest first (table of the paper).
const WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// Pixels of the window's side.
pub(super) const WINDOW: usize = 11;

/// Deviation of the window, pixels.
const SIGMA: f64 = 1.5;

/// `(0.01 L)^2` with `L` = 1: keeps the comparison of means finite.
const C1: f32 = 1e-4;

/// `(0.03 L)^2`: keeps the comparison of contrasts finite.
const C2: f32 = 9e-4;

/// Least value of a scale. Contrasts that oppose each other have negative ones, of which there is no fractional
/// power, and at zero its gradient is infinite.
const FLOOR: f64 = 1e-3;

/// The similarity with its window.
#[derive(Clone, Debug)]
pub(super) struct MsSsim {
    /// `[11]`, sum 1.
    window: Tensor<1>,
}

impl MsSsim {
    pub(super) fn new(device: &Device) -> Self {
        let middle = (WINDOW / 2) as f64;
        let window: Vec<f64> =
            (0..WINDOW).map(|i| (-0.5 * ((i as f64 - middle) / SIGMA).powi(2)).exp()).collect();
        let sum: f64 = window.iter().sum();
        let window: Vec<f32> = window.iter().map(|value| (value / sum) as f32).collect();
        Self { window: Tensor::from_floats(window.as_slice(), device) }
    }

    /// 1 - MS-SSIM, `[images]`, from images `[images, 1, height, width]` in [0, 1].
    ///
    /// Five scales, or as many as the window fits; their weights then sum to 1 again.
    pub(super) fn distances(&self, mut p: Tensor<4>, mut q: Tensor<4>) -> Tensor<1> {
        let [images, _, height, width] = p.dims();
        let weights = &WEIGHTS[..scales([height, width], WINDOW, WEIGHTS.len())];
        let total: f64 = weights.iter().sum();
        let mut sum = Tensor::zeros([images], &p.device());
        for (scale, weight) in weights.iter().enumerate() {
            let last = scale + 1 == weights.len();
            let value = super::image_means(self.similarity(p.clone(), q.clone(), last));
            let value = value.clamp_min(FLOOR).log();
            sum = sum + value * (weight / total) as f32;
            if !last {
                (p, q) = (halve(p), halve(q));
            }
        }
        1.0 - sum.exp()
    }

    /// Agreement of contrast and structure, at the last scale of the means, too, at every pixel whose window is
    /// within the image.
    fn similarity(&self, p: Tensor<4>, q: Tensor<4>, last: bool) -> Tensor<4> {
        let images = p.dims()[0];
        let planes =
            vec![p.clone(), q.clone(), p.clone().powi_scalar(2), q.clone().powi_scalar(2), p * q];
        let means = self.blur(Tensor::cat(planes, 0));
        let mean = |number: usize| means.clone().narrow(0, number * images, images);
        let (p, q) = (mean(0), mean(1));
        let (squares, product) = (p.clone().powi_scalar(2) + q.clone().powi_scalar(2), p * q);
        let contrast =
            ((mean(4) - product.clone()) * 2.0 + C2) / (mean(2) + mean(3) - squares.clone() + C2);
        if last { contrast * ((product * 2.0 + C1) / (squares + C1)) } else { contrast }
    }

    /// Gaussian means, without the pixels whose window reaches past the borders.
    fn blur(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, _, height, width] = x.dims();
        let window = self.window.clone();
        let zero = Tensor::zeros([1], &x.device());
        let across = window.clone().reshape([1, 1, 1, WINDOW]);
        let x = conv_2d(&[x], across, zero.clone(), Options::default());
        let x = x.narrow(3, WINDOW / 2, width + 1 - WINDOW);
        let x = conv_2d(&[x], window.reshape([1, 1, WINDOW, 1]), zero, Options::default());
        x.narrow(2, WINDOW / 2, height + 1 - WINDOW)
    }
}
