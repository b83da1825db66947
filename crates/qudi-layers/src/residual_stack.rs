//! Stacks of residual blocks of plain 3 x 3 convolutions.

use super::conv::{Bias, Conv2d};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::StackParameters;
use qudi_kernels::conv::Activation;

/// An entry convolution, with ReLU or without, then residual blocks: `x + second(relu(first(x)))`.
#[derive(Module, Debug)]
pub struct ResidualStack {
    entry: Conv2d,
    blocks: Vec<ResidualBlock>,
    #[module(skip)]
    rectifies: bool,
}

/// The convolutions of a residual block.
#[derive(Module, Debug)]
struct ResidualBlock {
    first: Conv2d,
    second: Conv2d,
}

impl ResidualStack {
    /// Creates a stack of zeros; [`init_parameters`](crate::init_parameters) gives weights their values by name.
    pub fn zeros([inputs, features]: [usize; 2], blocks: usize, device: &Device) -> Self {
        let conv = |inputs| Conv2d::zeros([inputs, features], 3, Bias::Yes, device);
        let block = |_| ResidualBlock { first: conv(features), second: conv(features) };
        Self { entry: conv(inputs), blocks: (0..blocks).map(block).collect(), rectifies: true }
    }

    /// Leaves out the ReLU of the entry. Where it has one, all of its units can be off for every input; then
    /// no gradient passes, and the stack learns no more.
    #[must_use]
    pub fn with_linear_entry(self) -> Self {
        Self { rectifies: false, ..self }
    }

    /// Makes the parameters ready for several uses.
    pub fn parameters(&self) -> StackParameters {
        let blocks = self.blocks.iter().flat_map(|block| [&block.first, &block.second]);
        let convolutions = std::iter::once(&self.entry).chain(blocks);
        let convolutions = convolutions.map(|conv| (conv.weight(), conv.bias_or_zeros()));
        let entry = if self.rectifies { Activation::Relu } else { Activation::None };
        StackParameters::new(convolutions.collect(), entry)
    }

    /// Computes the features of `inputs`, which are joined by channel.
    ///
    /// # Shapes
    /// - inputs: `[images, channels, height, width]` each
    /// - output: `[images, features, height, width]`
    pub fn forward(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.parameters().apply(inputs)
    }
}
