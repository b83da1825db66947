//! Stacks of residual blocks at one resolution, with their gradients.
//!
//! On processors that multiply bfloat16 (AMX, or AVX512-BF16 by AMD) a stack is one operation: between its
//! convolutions activations stay bfloat16 with channels last, so that tiles are loaded straight from them,
//! and bias, ReLU and shortcut are applied to each tile of sums. On LibTorch it is one operation, too, with
//! channels last. Elsewhere, and on a processor with 32 bits, a stack is composed of single convolutions.

#[cfg(all(feature = "flex", target_arch = "x86_64"))]
mod amx;
#[cfg(feature = "flex")]
mod backward;
#[cfg(feature = "flex")]
mod buffer;
#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod forward;
#[cfg(feature = "flex")]
mod grid;
#[cfg(feature = "flex")]
mod layout;
#[cfg(test)]
mod tests;
#[cfg(feature = "libtorch")]
mod torch;
#[cfg(feature = "flex")]
mod transposition;
#[cfg(feature = "flex")]
mod unit;
#[cfg(all(feature = "flex", target_arch = "x86_64"))]
mod vectors;
#[cfg(feature = "flex")]
mod weights;

use crate::backend::{is_native, is_recorded};
use crate::conv::{Activation, Options, conv_2d};
use crate::matrix_units::MatrixUnits;
use crate::operations::count;
use crate::precision::ComputePrecision;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::{INPUTS, StackBackend};
use std::cell::OnceCell;

/// The sizes of a stack of residual blocks.
#[derive(Clone, Debug)]
pub struct Stack {
    /// Number of images.
    pub images: usize,
    /// Rows of an image.
    pub height: usize,
    /// Columns of an image.
    pub width: usize,
    /// Channels of every input.
    pub inputs: Vec<usize>,
    /// Channels of the features: a multiple of 32 for the fused operation.
    pub features: usize,
    /// Number of residual blocks.
    pub blocks: usize,
    /// What follows the entry.
    pub entry: Activation,
    /// True if activations have 16 bits (bfloat16).
    pub bf16: bool,
    /// The units that multiply, on the processor.
    pub units: MatrixUnits,
    /// The parameters as the matrix unit reads them.
    #[cfg(feature = "flex")]
    packed: weights::Packed,
}

/// The parameters of a stack of residual blocks, made ready once for several uses.
#[derive(Debug)]
pub struct StackParameters {
    /// Weight `[outputs, inputs, 3, 3]` and bias `[outputs]`: the entry, then two for every block.
    convolutions: Vec<(Tensor<4>, Tensor<1>)>,
    entry: Activation,
    /// All of them one after the other, for the fused operation.
    joined: OnceCell<Tensor<1>>,
    #[cfg(feature = "flex")]
    packed: weights::Packed,
}

impl Stack {
    /// Returns the channels of all inputs together.
    pub(crate) fn channels(&self) -> usize {
        self.inputs.iter().sum()
    }

    /// Returns true if a ReLU follows the entry.
    #[cfg(any(feature = "flex", feature = "libtorch"))]
    pub(crate) fn rectifies(&self) -> bool {
        self.entry == Activation::Relu
    }

    /// Returns inputs and outputs of every convolution, in order.
    pub(crate) fn convolutions(&self) -> impl Iterator<Item = [usize; 2]> {
        let entry = [self.channels(), self.features];
        std::iter::once(entry).chain([[self.features; 2]].repeat(2 * self.blocks))
    }
}

/// Computes `x = relu(entry(inputs))`, or `entry(inputs)` if no activation follows the entry, then
/// `x = x + second(relu(first(x)))` for every block.
///
/// # Shapes
/// - inputs: `[images, channels, height, width]` each, joined by channel
/// - convolutions: weight `[outputs, inputs, 3, 3]` and bias `[outputs]`: the entry, then two for every block
/// - output: `[images, features, height, width]`
///
/// # Panics
/// If the shapes do not fit.
pub fn residual_stack(
    inputs: &[Tensor<4>],
    convolutions: &[(Tensor<4>, Tensor<1>)],
    entry: Activation,
) -> Tensor<4> {
    StackParameters::new(convolutions.to_vec(), entry).apply(inputs)
}

impl StackParameters {
    /// Takes the convolutions of a stack: the entry, then two for every block; and what follows the entry.
    pub fn new(convolutions: Vec<(Tensor<4>, Tensor<1>)>, entry: Activation) -> Self {
        Self {
            convolutions,
            entry,
            joined: OnceCell::new(),
            #[cfg(feature = "flex")]
            packed: weights::Packed::default(),
        }
    }

    /// Computes [`residual_stack`].
    ///
    /// # Panics
    /// If the shapes do not fit.
    pub fn apply(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        let stack = self.stack(inputs);
        if is_fused(&inputs[0], &stack) {
            return self.fused(inputs, stack);
        }
        let conv = |inputs: &[Tensor<4>], number: usize, addend, activation| {
            let (weight, bias) = self.convolutions[number].clone();
            conv_2d(inputs, weight, bias, Options { addend, activation, ..Options::default() })
        };
        let mut x = conv(inputs, 0, None, self.entry);
        for block in 0..stack.blocks {
            let hidden = conv(std::slice::from_ref(&x), 1 + 2 * block, None, Activation::Relu);
            x = conv(&[hidden], 2 + 2 * block, Some(x), Activation::None);
        }
        x
    }

    fn stack(&self, inputs: &[Tensor<4>]) -> Stack {
        let [images, _, height, width] = inputs[0].dims();
        let [features, ..] = self.convolutions[0].0.dims();
        let stack = Stack {
            images,
            height,
            width,
            inputs: inputs.iter().map(|input| input.dims()[1]).collect(),
            features,
            blocks: (self.convolutions.len() - 1) / 2,
            entry: self.entry,
            bf16: ComputePrecision::reduces(&inputs[0]),
            units: MatrixUnits::current(),
            #[cfg(feature = "flex")]
            packed: self.packed.clone(),
        };
        assert_eq!(self.convolutions.len(), 1 + 2 * stack.blocks, "an entry, and two per block");
        for (input, &channels) in inputs.iter().zip(&stack.inputs) {
            assert_eq!(input.dims(), [images, channels, height, width], "inputs of one stack");
        }
        let sizes = stack.convolutions();
        for ((weight, bias), [inputs, outputs]) in self.convolutions.iter().zip(sizes) {
            assert_eq!(weight.dims(), [outputs, inputs, 3, 3], "a weight of the stack");
            assert_eq!(bias.dims(), [outputs], "one bias for every output channel");
        }
        stack
    }

    fn fused(&self, inputs: &[Tensor<4>], stack: Stack) -> Tensor<4> {
        if inputs.len() > INPUTS {
            let joined = Tensor::cat(inputs.to_vec(), 1);
            let stack = Stack { inputs: vec![stack.channels()], ..stack };
            return self.fused(&[joined], stack);
        }
        let parameters = self.joined.get_or_init(|| {
            let flat = self.convolutions.iter().flat_map(|(weight, bias)| {
                let values = weight.shape().num_elements();
                [weight.clone().reshape([values]), bias.clone()]
            });
            Tensor::cat(flat.collect(), 0)
        });
        let weights = self.convolutions.iter().map(|(weight, _)| weight.shape().num_elements());
        let places = stack.images * stack.height * stack.width;
        count(weights.sum(), places, &inputs[0].device());
        let parameters = parameters.clone().into_dispatch();
        let unused = Tensor::<1>::zeros([1], &inputs[0].device()).into_dispatch();
        let mut list = inputs.iter().map(|input| input.clone().into_dispatch());
        let [a, b, c, d, e, f, g]: [_; INPUTS] =
            std::array::from_fn(|_| list.next().unwrap_or_else(|| unused.clone()));
        Tensor::from_dispatch(Dispatch::residual_stack(a, b, c, d, e, f, g, parameters, stack))
    }
}

/// Returns true if the stack is computed as one operation.
fn is_fused(input: &Tensor<4>, stack: &Stack) -> bool {
    let fits_tiles = || {
        is_native(input)
            && stack.bf16
            && stack.units != MatrixUnits::F32
            && stack.features.is_multiple_of(32)
    };
    stack.images * stack.height * stack.width > 0 && (is_recorded(input) || fits_tiles())
}
