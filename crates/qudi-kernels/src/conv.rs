//! Convolutions over frames, in two and three dimensions, with their gradients.
//!
//! Frames are folded into the batch, `[bursts * frames, channels, height, width]`. A kernel that spans
//! several frames reads its neighbours there. The flex backend convolves the planes directly: it copies a
//! tile of all input planes with its borders to scratch memory, and blocks of output channels and pixels run
//! over all taps in registers. Unfolding into a matrix (im2col) copies each value once per tap; this copies
//! it once, which matters with few channels. With bfloat16 the copy is rounded, and blocks run on the
//! processor's matrix units. Graphics cards use Burn's convolutions, and matrix products for the gradient of
//! the weights. Other backends use Burn's operations alone.

#[cfg(all(feature = "flex", target_arch = "x86_64"))]
mod amx;
#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
mod geometry;
#[cfg(feature = "flex")]
mod micro;
#[cfg(feature = "flex")]
pub(crate) mod native;
#[cfg(all(feature = "flex", target_arch = "x86_64"))]
mod pairs;
#[cfg(feature = "flex")]
mod pass;
#[cfg(feature = "flex")]
mod run;
#[cfg(feature = "flex")]
mod scratch;
#[cfg(feature = "flex")]
mod source;
#[cfg(any(feature = "cube", feature = "libtorch", test))]
mod stock;
#[cfg(feature = "flex")]
mod tiles;
#[cfg(feature = "flex")]
mod weight_gradient;
#[cfg(feature = "flex")]
mod weight_tiles;
#[cfg(feature = "flex")]
mod winograd;

pub use geometry::Geometry;
#[cfg(feature = "flex")]
pub(crate) use scratch::upper;

#[cfg(all(feature = "flex", target_arch = "x86_64"))]
pub(crate) use amx::agrees as tiles_multiply;

use crate::backend::{is_cube, is_native, is_recorded};
use crate::operations::count;
use crate::precision::{ComputePrecision, Reduced};
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::module::{conv2d, conv3d};
use burn::tensor::ops::ConvOptions;
use extension::{ConvBackend, MAX_INPUTS};

/// Options of one convolution.
#[derive(Clone, Debug)]
pub struct Options {
    /// Stride of the output in rows and columns: 1 or 2.
    pub stride: usize,
    /// Tensor added to the result, of its shape.
    pub addend: Option<Tensor<4>>,
    /// Activation applied to the result.
    pub activation: Activation,
}

/// Activation applied after the sum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// No activation.
    None,
    /// Negative values become zero.
    Relu,
}

impl Default for Options {
    fn default() -> Self {
        Self { stride: 1, addend: None, activation: Activation::None }
    }
}

/// Convolves each frame of `inputs`, joined by channel.
///
/// # Shapes
/// `inputs`: `[images, channels, height, width]` each; `weight`: `[outputs, channels, rows,
/// columns]`, odd kernel; `bias`: `[outputs]`. Result: `[images, outputs, ceil(height / stride), ceil(width /
/// stride)]`: padding is half the kernel.
pub fn conv_2d(
    inputs: &[Tensor<4>],
    weight: Tensor<4>,
    bias: Tensor<1>,
    options: Options,
) -> Tensor<4> {
    let [outputs, channels, rows, columns] = weight.dims();
    if is_extended(&inputs[0]) {
        let weight = weight.reshape([outputs, channels, 1, rows, columns]);
        return extended(inputs, weight, bias, 1, options);
    }
    if let Some(numbers) = Reduced::of(&inputs[0]) {
        let sum = |inputs: &[_], weight, zeros, options| conv_2d(inputs, weight, zeros, options);
        return reduced(numbers, inputs, weight, bias, options, sum);
    }
    count_convolution(&inputs[0], weight.shape().num_elements(), options.stride);
    let stride = [options.stride, options.stride];
    let padding = [rows / 2, columns / 2];
    let stock = ConvOptions::new(stride, padding, [1, 1], 1);
    finish(conv2d(joined(inputs), weight, Some(bias), stock), options)
}

/// Convolves `inputs`, joined by channel, over the frames of each burst.
///
/// # Shapes
/// `inputs`: `[bursts * frames, channels, height, width]` each; `weight`: `[outputs, channels, frames, rows,
/// columns]`, odd kernel; `bias`: `[outputs]`. Result: `[bursts * frames, outputs, ceil(height / stride),
/// ceil(width / stride)]`: padding is half the kernel, zeros past the ends of the burst.
pub fn conv_3d(
    inputs: &[Tensor<4>],
    weight: Tensor<5>,
    bias: Tensor<1>,
    frames: usize,
    options: Options,
) -> Tensor<4> {
    if is_extended(&inputs[0]) {
        return extended(inputs, weight, bias, frames, options);
    }
    if let Some(numbers) = Reduced::of(&inputs[0]) {
        let sum =
            |inputs: &[_], weight, zeros, options| conv_3d(inputs, weight, zeros, frames, options);
        return reduced(numbers, inputs, weight, bias, options, sum);
    }
    count_convolution(&inputs[0], weight.shape().num_elements(), options.stride);
    let [outputs, _, depth, rows, columns] = weight.dims();
    let joined = joined(inputs);
    let [images, channels, height, width] = joined.dims();
    let bursts = joined.reshape([images / frames, frames, channels, height, width]);
    let padding = [depth / 2, rows / 2, columns / 2];
    let stride = [1, options.stride, options.stride];
    let stock = ConvOptions::new(stride, padding, [1, 1, 1], 1);
    let output = conv3d(bursts.swap_dims(1, 2), weight, Some(bias), stock); // [B, O, N, h, w]
    let [_, _, _, height, width] = output.dims();
    finish(output.swap_dims(1, 2).reshape([images, outputs, height, width]), options)
}

/// Computes a convolution in the thread's reduced precision. Addend and activation have full precision.
fn reduced<const D: usize>(
    numbers: Reduced,
    inputs: &[Tensor<4>],
    weight: Tensor<D>,
    bias: Tensor<1>,
    options: Options,
    sum: impl FnOnce(&[Tensor<4>], Tensor<D>, Tensor<1>, Options) -> Tensor<4>,
) -> Tensor<4> {
    let narrow: Vec<_> = inputs.iter().map(|input| numbers.narrow(input.clone())).collect();
    let zeros = numbers.narrow(bias.zeros_like().detach());
    let alone = Options { stride: options.stride, ..Options::default() };
    let sum = sum(&narrow, numbers.narrow(weight), zeros, alone);
    let outputs = bias.dims()[0];
    finish(Reduced::widen(sum) + bias.reshape([1, outputs, 1, 1]), options)
}

fn joined(inputs: &[Tensor<4>]) -> Tensor<4> {
    if let [input] = inputs { input.clone() } else { Tensor::cat(inputs.to_vec(), 1) }
}

fn finish(mut output: Tensor<4>, options: Options) -> Tensor<4> {
    if let Some(addend) = options.addend {
        output = output + addend;
    }
    match options.activation {
        Activation::None => output,
        Activation::Relu => relu(output),
    }
}

/// Returns true if the backend extension of this crate convolves this tensor.
fn is_extended(input: &Tensor<4>) -> bool {
    is_native(input) || is_recorded(input) || is_cube(input)
}

/// Counts the operations of a convolution of images like `input`.
fn count_convolution(input: &Tensor<4>, weights: usize, stride: usize) {
    let [images, _, height, width] = input.dims();
    let places = images * height.div_ceil(stride) * width.div_ceil(stride);
    count(weights, places, &input.device());
}

/// Calls the backend extension of this crate.
fn extended(
    inputs: &[Tensor<4>],
    weight: Tensor<5>,
    bias: Tensor<1>,
    frames: usize,
    options: Options,
) -> Tensor<4> {
    if inputs.len() > MAX_INPUTS {
        return extended(&[joined(inputs)], weight, bias, frames, options);
    }
    count_convolution(&inputs[0], weight.shape().num_elements(), options.stride);
    let [images, _, height, width] = inputs[0].dims();
    let [outputs, _, depth, rows, columns] = weight.dims();
    let geometry = Geometry {
        images,
        frames,
        channels: inputs.iter().map(|input| input.dims()[1]).collect(),
        height,
        width,
        outputs,
        kernel: [depth, rows, columns],
        stride: options.stride,
        addend: options.addend.is_some(),
        relu: options.activation == Activation::Relu,
        bf16: ComputePrecision::reduces(&inputs[0]),
    };
    geometry.check(inputs, &weight, &bias, options.addend.as_ref());
    let unused = Tensor::<1>::zeros([1], &bias.device()).into_dispatch();
    let mut list = inputs.iter().map(|input| input.clone().into_dispatch());
    let [a, b, c, d, e]: [_; MAX_INPUTS] =
        std::array::from_fn(|_| list.next().unwrap_or_else(|| unused.clone()));
    let addend = options.addend.map_or(unused, Tensor::into_dispatch);
    let (weight, bias) = (weight.into_dispatch(), bias.into_dispatch());
    Tensor::from_dispatch(Dispatch::conv_frames(a, b, c, d, e, addend, weight, bias, geometry))
}

impl Geometry {
    /// Checks the shapes, on which the unchecked loops of `native` rely. A wrong shape is a broken invariant
    /// of the caller, as in Burn's own operations.
    fn check(
        &self,
        inputs: &[Tensor<4>],
        weight: &Tensor<5>,
        bias: &Tensor<1>,
        addend: Option<&Tensor<4>>,
    ) {
        for (input, &channels) in inputs.iter().zip(&self.channels) {
            let expected = [self.images, channels, self.height, self.width];
            assert_eq!(input.dims(), expected, "inputs of one convolution");
        }
        assert_eq!(weight.dims()[1], self.all_channels(), "channels of weight and inputs");
        assert_eq!(bias.dims(), [self.outputs], "one bias for every output channel");
        assert!(self.kernel.iter().all(|size| size % 2 == 1), "odd kernels only");
        assert!(matches!(self.stride, 1 | 2), "stride 1 or 2");
        assert_eq!(self.images % self.frames, 0, "whole bursts");
        if let Some(addend) = addend {
            let [rows, columns] = self.output_grid();
            let expected = [self.images, self.outputs, rows, columns];
            assert_eq!(addend.dims(), expected, "an addend of the output's shape");
        }
    }
}
