//! Convolution by operations that every backend has.
//!
//! Burn's gradient of the weights, unless it is autotuned for minutes, is a convolution with a kernel as
//! large as the image. Here it is a matrix product for every image: gradients times neighbourhoods.

use super::geometry::Geometry;
use burn::backend::Backend;
use burn::backend::TensorMetadata;
use burn::backend::tensor::FloatTensor;
#[cfg(feature = "libtorch")]
use burn::backend::{LibTorch, libtorch::TchTensor};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{FloatDType, Shape, Slice};

impl Geometry {
    fn padding(&self) -> [usize; 3] {
        self.kernel.map(|size| size / 2)
    }

    fn flat_options(&self) -> ConvOptions<2> {
        let [_, rows, columns] = self.padding();
        ConvOptions::new([self.stride; 2], [rows, columns], [1, 1], 1)
    }

    fn deep_options(&self) -> ConvOptions<3> {
        ConvOptions::new([1, self.stride, self.stride], self.padding(), [1, 1, 1], 1)
    }

    /// Returns true if the kernel spans several frames.
    fn is_deep(&self) -> bool {
        self.kernel[0] > 1
    }

    /// Returns the shape `[outputs, channels, rows, columns]` of the weight.
    fn flat_weight(&self) -> Shape {
        let [_, rows, columns] = self.kernel;
        Shape::new([self.outputs, self.all_channels(), rows, columns])
    }
}

/// Casts the operands of products to bfloat16 if the geometry requires it.
fn narrow<B: Backend>(x: FloatTensor<B>, geometry: &Geometry) -> FloatTensor<B> {
    if geometry.bf16 { B::float_cast(x, FloatDType::BF16) } else { x }
}

/// Casts the result of products to 32 bits.
fn widen<B: Backend>(x: FloatTensor<B>, geometry: &Geometry) -> FloatTensor<B> {
    if geometry.bf16 { B::float_cast(x, FloatDType::F32) } else { x }
}

fn joined<B: Backend>(mut inputs: Vec<FloatTensor<B>>) -> FloatTensor<B> {
    if inputs.len() == 1 { inputs.remove(0) } else { B::float_cat(inputs, 1) }
}

/// Reshapes `[bursts * frames, channels, height, width]` to `[bursts, channels, frames, height, width]`.
fn by_burst<B: Backend>(x: FloatTensor<B>, frames: usize) -> FloatTensor<B> {
    let [images, channels, height, width] = x.shape().dims();
    let shape = Shape::new([images / frames, frames, channels, height, width]);
    B::float_swap_dims(B::float_reshape(x, shape), 1, 2)
}

/// Applies the inverse of [`by_burst`].
fn by_image<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [bursts, channels, frames, height, width] = x.shape().dims();
    let shape = Shape::new([bursts * frames, channels, height, width]);
    B::float_reshape(B::float_swap_dims(x, 1, 2), shape)
}

/// Computes the convolution with addend and activation; `inputs` does not include the addend.
pub(super) fn forward<B: Backend>(
    geometry: &Geometry,
    inputs: Vec<FloatTensor<B>>,
    addend: Option<FloatTensor<B>>,
    weight: FloatTensor<B>,
    bias: FloatTensor<B>,
) -> FloatTensor<B> {
    let x = narrow::<B>(joined::<B>(inputs), geometry);
    let sum = products::<B>(geometry, x, narrow::<B>(weight, geometry));
    let bias = B::float_reshape(bias, Shape::new([1, geometry.outputs, 1, 1]));
    let mut output = B::float_add(widen::<B>(sum, geometry), bias);
    if let Some(addend) = addend {
        output = B::float_add(output, addend);
    }
    if geometry.relu { B::relu(output) } else { output }
}

/// Computes the sum of products of a convolution alone.
fn products<B: Backend>(
    geometry: &Geometry,
    x: FloatTensor<B>,
    weight: FloatTensor<B>,
) -> FloatTensor<B> {
    if geometry.is_deep() {
        let x = by_burst::<B>(x, geometry.frames);
        return by_image::<B>(B::conv3d(x, weight, None, geometry.deep_options()));
    }
    let weight = B::float_reshape(weight, geometry.flat_weight());
    B::conv2d(x, weight, None, geometry.flat_options())
}

/// Computes the gradient before the ReLU.
fn uncut<B: Backend>(gradient: FloatTensor<B>, output: Option<FloatTensor<B>>) -> FloatTensor<B> {
    match output {
        None => gradient,
        Some(output) => {
            // The output is not negative: its sign is one where the gradient passes.
            B::float_mul(gradient, B::float_sign(output))
        }
    }
}

/// Computes the gradients of every input and of the addend.
pub(super) fn input_gradients<B: Backend>(
    geometry: &Geometry,
    weight: FloatTensor<B>,
    gradient: FloatTensor<B>,
    output: Option<FloatTensor<B>>,
) -> Vec<FloatTensor<B>> {
    let gradient = uncut::<B>(gradient, output);
    let Geometry { images, frames, height, width, .. } = *geometry;
    let channels = geometry.all_channels();
    let (narrowed, weight) =
        (narrow::<B>(gradient.clone(), geometry), narrow::<B>(weight, geometry));
    // The input gradient only reads the shape of its input.
    let (device, dtype) = (weight.device(), weight.dtype());
    let like = |shape: Shape| B::float_zeros(shape, &device, dtype.into());
    let all = if geometry.is_deep() {
        let like = like(Shape::new([images / frames, channels, frames, height, width]));
        let narrowed = by_burst::<B>(narrowed, frames);
        by_image::<B>(B::conv3d_x_backward(like, weight, narrowed, geometry.deep_options()))
    } else {
        let like = like(Shape::new([images, channels, height, width]));
        let weight = B::float_reshape(weight, geometry.flat_weight());
        B::conv2d_x_backward(like, weight, narrowed, geometry.flat_options())
    };
    let all = widen::<B>(all, geometry);
    let mut first = 0;
    let mut parts = Vec::new();
    for &count in &geometry.channels {
        let channels = Slice::from(first..first + count);
        parts.push(B::float_slice(all.clone(), &[Slice::full(), channels]));
        first += count;
    }
    parts.extend(geometry.addend.then_some(gradient));
    parts
}

/// Computes the gradients of weight and bias.
#[cfg(any(feature = "cube", test))]
pub(super) fn weight_gradients<B: Backend>(
    geometry: &Geometry,
    inputs: Vec<FloatTensor<B>>,
    gradient: FloatTensor<B>,
    output: Option<FloatTensor<B>>,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let gradient = uncut::<B>(gradient, output);
    let Geometry { images, frames, outputs, .. } = *geometry;
    let [height, width] = geometry.output_grid();
    let flat = Shape::new([images, outputs, height * width]);
    let gradient = B::float_reshape(gradient, flat);
    let sums = B::float_sum_dim(B::float_sum_dim(gradient.clone(), 2), 0);
    let bias = B::float_reshape(sums, Shape::new([outputs]));

    let gradient = narrow::<B>(gradient, geometry);
    let x = padded::<B>(geometry, narrow::<B>(joined::<B>(inputs), geometry));
    let [depth, rows, columns] = geometry.kernel;
    let (channels, taps) = (geometry.all_channels(), rows * columns);
    let slices = (0..depth).map(|dt| {
        let x = shifted::<B>(x.clone(), frames, dt, depth);
        let around = neighbourhoods::<B>(geometry, &x);
        let products = B::float_matmul(gradient.clone(), B::float_swap_dims(around, 1, 2));
        let sum = B::float_sum_dim(widen::<B>(products, geometry), 0);
        let sum = B::float_reshape(sum, Shape::new([outputs, taps, channels]));
        let sum = B::float_swap_dims(sum, 1, 2);
        B::float_reshape(sum, Shape::new([outputs, channels, 1, rows, columns]))
    });
    let slices: Vec<_> = slices.collect();
    let weight =
        if slices.len() == 1 { slices.into_iter().next() } else { Some(B::float_cat(slices, 2)) };
    (weight.expect("a kernel of at least one frame"), bias)
}

/// Computes the gradients of weight and bias by LibTorch's own kernel, which only its record gives: the sum
/// is computed once more.
#[cfg(feature = "libtorch")]
pub(super) fn recorded_weight_gradients(
    geometry: &Geometry,
    inputs: Vec<TchTensor>,
    gradient: TchTensor,
    output: Option<TchTensor>,
) -> [TchTensor; 2] {
    let gradient = uncut::<LibTorch>(gradient, output);
    let bias = gradient.tensor.sum_dim_intlist([0, 2, 3].as_slice(), false, None);
    let x = narrow::<LibTorch>(joined::<LibTorch>(inputs), geometry);
    let [depth, rows, columns] = geometry.kernel;
    let shape = [geometry.outputs, geometry.all_channels(), depth, rows, columns];
    let zeros = tch::Tensor::zeros(shape.map(|n| n as i64), (x.tensor.kind(), x.tensor.device()));
    let (_, record) = crate::libtorch::recorded(vec![TchTensor::new(zeros)], |leaves| {
        let weight = TchTensor::new(leaves[0].shallow_clone());
        products::<LibTorch>(geometry, x, weight).tensor
    });
    let weight = record.gradients(&gradient).swap_remove(0);
    [widen::<LibTorch>(weight, geometry), TchTensor::new(bias)]
}

/// Pads the images with zeros.
#[cfg(any(feature = "cube", test))]
fn padded<B: Backend>(geometry: &Geometry, x: FloatTensor<B>) -> FloatTensor<B> {
    let [_, rows, columns] = geometry.padding();
    if rows == 0 && columns == 0 {
        return x;
    }
    let [images, channels, height, width] = x.shape().dims();
    let shape = Shape::new([images, channels, height + 2 * rows, width + 2 * columns]);
    let zeros = B::float_zeros(shape, &x.device(), x.dtype().into());
    let inside = [
        Slice::full(),
        Slice::full(),
        Slice::from(rows..rows + height),
        Slice::from(columns..columns + width),
    ];
    B::float_slice_assign(zeros, &inside, x)
}

/// Shifts images by `dt - depth / 2` frames within their bursts, with zeros past the ends.
#[cfg(any(feature = "cube", test))]
fn shifted<B: Backend>(
    x: FloatTensor<B>,
    frames: usize,
    dt: usize,
    depth: usize,
) -> FloatTensor<B> {
    let middle = depth / 2;
    if dt == middle {
        return x;
    }
    let [images, channels, height, width] = x.shape().dims();
    let shape = Shape::new([images / frames, frames, channels, height, width]);
    let zeros = B::float_zeros(shape.clone(), &x.device(), x.dtype().into());
    let later = dt.abs_diff(middle).min(frames);
    if later == frames {
        return B::float_reshape(zeros, Shape::new([images, channels, height, width]));
    }
    let (from, to) = (later..frames, 0..frames - later);
    let (from, to) = if dt > middle { (from, to) } else { (to, from) };
    let part = B::float_slice(B::float_reshape(x, shape), &[Slice::full(), Slice::from(from)]);
    let moved = B::float_slice_assign(zeros, &[Slice::full(), Slice::from(to)], part);
    B::float_reshape(moved, Shape::new([images, channels, height, width]))
}

/// Gathers the pixels that each tap reads for each cell of padded images, `[images, taps * channels, cells]`.
#[cfg(any(feature = "cube", test))]
fn neighbourhoods<B: Backend>(geometry: &Geometry, x: &FloatTensor<B>) -> FloatTensor<B> {
    let [_, rows, columns] = geometry.kernel;
    let [height, width] = geometry.output_grid();
    let step = geometry.stride;
    let along = |first: usize, count: usize| {
        let last = first + (count - 1) * step + 1;
        Slice::new(first as isize, Some(last as isize), step as isize)
    };
    let mut taps = Vec::with_capacity(rows * columns);
    for row in 0..rows {
        for column in 0..columns {
            let place = [Slice::full(), Slice::full(), along(row, height), along(column, width)];
            taps.push(B::float_slice(x.clone(), &place));
        }
    }
    let channels = rows * columns * geometry.all_channels();
    B::float_reshape(joined::<B>(taps), Shape::new([geometry.images, channels, height * width]))
}

#[cfg(all(test, feature = "flex"))]
mod tests {
    use super::super::extension::ConvGradients;
    use super::*;
    use crate::flex::{tensor, values};
    use burn::backend::Flex;
    use burn::backend::flex::FlexTensor;

    fn random<const D: usize>(seed: u64, shape: [usize; D]) -> FlexTensor {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        };
        tensor((0..shape.iter().product()).map(|_| next()).collect(), shape)
    }

    fn assert_close(what: &str, one: FlexTensor, other: &FlexTensor) {
        assert_eq!(one.shape(), other.shape(), "{what}");
        let one = crate::flex::contiguous(one);
        let pairs = values(&one).iter().zip(values(other));
        let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let largest = values(other).iter().fold(1.0f32, |most, v| most.max(v.abs()));
        assert!(worst < 2e-5 * largest, "{what}: {worst} of {largest}");
    }

    /// Compares both implementations over strides, odd sizes, several inputs and temporal kernels, with and
    /// without ReLU.
    #[test]
    fn gradients_equal_those_of_our_own_loops() {
        let cases = [
            ([1, 3, 3], 1, vec![3], [7, 10]),
            ([1, 3, 3], 2, vec![2, 3], [9, 12]),
            ([1, 7, 7], 1, vec![4], [8, 6]),
            ([1, 1, 1], 1, vec![5, 1], [5, 4]),
            ([5, 5, 5], 1, vec![3], [6, 8]),
            ([5, 5, 5], 2, vec![2], [8, 7]),
        ];
        for (kernel, stride, channels, [height, width]) in cases {
            for relu in [false, true] {
                let (images, frames, outputs) = (6, 3, 4);
                let geometry = Geometry {
                    images,
                    frames,
                    channels: channels.clone(),
                    height,
                    width,
                    outputs,
                    kernel,
                    stride,
                    addend: relu,
                    relu,
                    bf16: false,
                };
                let [rows, columns] = geometry.output_grid();
                let grid = [images, outputs, rows, columns];
                let inputs: Vec<_> = (1..).zip(&channels).collect();
                let inputs: Vec<_> = inputs
                    .into_iter()
                    .map(|(seed, &count)| random(seed, [images, count, height, width]))
                    .collect();
                let [depth, high, wide] = kernel;
                let weight = random(20, [outputs, geometry.all_channels(), depth, high, wide]);
                let (gradient, addend) = (random(21, grid), random(22, grid));
                let bias = random(23, [outputs]);
                let given = relu.then(|| addend.clone());
                let output = forward::<Flex>(
                    &geometry,
                    inputs.clone(),
                    given.clone(),
                    weight.clone(),
                    bias.clone(),
                );
                let all: Vec<_> = inputs.iter().chain(&given).map(values).collect();
                let ours =
                    super::super::native::forward(&geometry, &all, values(&weight), values(&bias));
                assert_close("output", output.clone(), &tensor(ours, grid));
                let mask = || relu.then(|| output.clone());
                let own = Flex::conv_input_gradients(
                    weight.clone(),
                    gradient.clone(),
                    mask(),
                    geometry.clone(),
                );
                let stock = input_gradients::<Flex>(&geometry, weight, gradient.clone(), mask());
                assert_eq!(own.len(), stock.len());
                for (own, stock) in own.iter().zip(stock) {
                    assert_close("input", stock, own);
                }
                let own = Flex::conv_weight_gradients(
                    inputs.clone(),
                    gradient.clone(),
                    mask(),
                    geometry.clone(),
                );
                let stock = weight_gradients::<Flex>(&geometry, inputs, gradient, mask());
                assert_close("weight", stock.0, &own.0);
                assert_close("bias", stock.1, &own.1);
            }
        }
    }
}
