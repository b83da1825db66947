//! Frozen convolutions with a ReLU, all of them computed with stride 1.

use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_kernels::conv::{Activation, Options, conv_2d};
use qudi_layers::resample::pixel_unshuffle;

/// A convolution. Its weights are constants: no gradient is kept for them.
#[derive(Clone, Debug)]
pub(super) struct Convolution {
    /// `[outputs, inputs, rows, columns]`
    weight: Tensor<4>,
    /// `[outputs]`
    bias: Tensor<1>,
    strided: Option<Strided>,
}

/// How a convolution with a stride becomes one without: squares of stride x stride pixels are folded into
/// channels, and the kernel likewise, filled up with zeros.
#[derive(Clone, Copy, Debug)]
struct Strided {
    /// The kernel of the original.
    kernel: usize,
    /// The stride of the original.
    stride: usize,
    /// The padding of the original.
    padding: usize,
    /// Side of the folded kernel, odd.
    folded: usize,
}

impl Convolution {
    /// Makes a convolution of stride 1 and padding of half the kernel. `sizes` are outputs, inputs and the
    /// odd side of the kernel.
    pub(super) fn new(
        weight: Vec<f32>,
        bias: Vec<f32>,
        [outputs, inputs, kernel]: [usize; 3],
        device: &Device,
    ) -> Self {
        let shape = [outputs, inputs, kernel, kernel];
        Self {
            weight: Tensor::from_data(TensorData::new(weight, shape), device),
            bias: Tensor::from_data(TensorData::new(bias, [outputs]), device),
            strided: None,
        }
    }

    /// Makes a convolution of any stride and padding.
    pub(super) fn strided(
        weight: &[f32],
        bias: Vec<f32>,
        [outputs, inputs, kernel]: [usize; 3],
        [stride, padding]: [usize; 2],
        device: &Device,
    ) -> Self {
        let folded = kernel.div_ceil(stride) | 1;
        let channels = inputs * stride * stride;
        let mut values = vec![0.0; outputs * channels * folded * folded];
        for (number, row) in weight.chunks_exact(kernel).enumerate() {
            let (plane, y) = (number / kernel, number % kernel);
            for (x, &value) in row.iter().enumerate() {
                // As `fold` numbers its channels.
                let channel = (plane * stride + y % stride) * stride + x % stride;
                values[(channel * folded + y / stride) * folded + x / stride] = value;
            }
        }
        let plain = Self::new(values, bias, [outputs, channels, folded], device);
        Self { strided: Some(Strided { kernel, stride, padding, folded }), ..plain }
    }

    /// Convolves and applies the ReLU.
    ///
    /// # Shapes
    /// - x: `[images, inputs, height, width]`
    /// - output: `[images, outputs, rows, columns]`
    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let options = Options { activation: Activation::Relu, ..Options::default() };
        let (weight, bias) = (self.weight.clone(), self.bias.clone());
        let Some(Strided { kernel, stride, padding, folded }) = self.strided else {
            return conv_2d(&[x], weight, bias, options);
        };
        let [_, _, height, width] = x.dims();
        let grid = |size: usize| (size + 2 * padding).saturating_sub(kernel) / stride + 1;
        let pads = |size: usize| {
            let whole = stride * (grid(size) + folded - 1);
            (padding, whole.saturating_sub(size + padding))
        };
        let x = x.pad([(0, 0), (0, 0), pads(height), pads(width)], PadMode::Constant(0.0));
        let y = conv_2d(&[pixel_unshuffle(x, stride)], weight, bias, options);
        y.narrow(2, folded / 2, grid(height)).narrow(3, folded / 2, grid(width))
    }
}
