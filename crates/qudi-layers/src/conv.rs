//! Convolutions of single frames and over frames.

use super::parameters::zeros;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};

/// A convolution of each frame.
#[derive(Module, Debug)]
pub struct Conv2d {
    /// `[outputs, inputs, rows, columns]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Option<Param<Tensor<1>>>,
}

/// A convolution over the frames of bursts.
#[derive(Module, Debug)]
pub struct Conv3d {
    /// `[outputs, inputs, frames, rows, columns]`
    weight: Param<Tensor<5>>,
    /// `[outputs]`
    bias: Option<Param<Tensor<1>>>,
}

/// Presence of a layer's bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bias {
    /// With a bias.
    Yes,
    /// Without a bias.
    No,
}

/// Returns the bias, or zeros for every output of `weight`.
fn bias_or_zeros<const D: usize>(bias: Option<&Param<Tensor<1>>>, weight: &Tensor<D>) -> Tensor<1> {
    bias.map_or_else(|| Tensor::zeros([weight.dims()[0]], &weight.device()), Param::val)
}

impl Conv2d {
    /// Creates a layer of zeros; [`init_parameters`](crate::init_parameters) sets weights by name.
    pub fn zeros(
        [inputs, outputs]: [usize; 2],
        kernel: usize,
        bias: Bias,
        device: &Device,
    ) -> Self {
        Self {
            weight: zeros([outputs, inputs, kernel, kernel], device),
            bias: (bias == Bias::Yes).then(|| zeros([outputs], device)),
        }
    }

    /// Returns the weights, `[outputs, inputs, rows, columns]`.
    pub fn weight(&self) -> Tensor<4> {
        self.weight.val()
    }

    /// Returns the bias, `[outputs]`, zeros where there is none.
    pub fn bias_or_zeros(&self) -> Tensor<1> {
        bias_or_zeros(self.bias.as_ref(), &self.weight.val())
    }

    /// Applies the convolution to `inputs`, `[images, channels, height, width]`, joined by channel.
    pub fn linear(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options::default())
    }

    /// Applies the convolution and adds `addend`.
    pub fn add(&self, inputs: &[Tensor<4>], addend: Tensor<4>) -> Tensor<4> {
        self.call(inputs, Options { addend: Some(addend), ..Options::default() })
    }

    /// Applies the convolution, adds `addend`, and applies ReLU.
    pub fn add_relu(&self, inputs: &[Tensor<4>], addend: Tensor<4>) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(inputs, Options { addend: Some(addend), activation, ..Options::default() })
    }

    /// Applies the convolution and ReLU.
    pub fn relu(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options { activation: Activation::Relu, ..Options::default() })
    }

    /// Applies the convolution with stride 2.
    pub fn stride2(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options { stride: 2, ..Options::default() })
    }

    fn call(&self, inputs: &[Tensor<4>], options: Options) -> Tensor<4> {
        let weight = self.weight.val();
        let bias = bias_or_zeros(self.bias.as_ref(), &weight);
        conv_2d(inputs, weight, bias, options)
    }
}

impl Conv3d {
    /// Creates a layer of zeros with a kernel of 5 x 5 x 5.
    pub fn zeros([inputs, outputs]: [usize; 2], bias: Bias, device: &Device) -> Self {
        Self {
            weight: zeros([outputs, inputs, 5, 5, 5], device),
            bias: (bias == Bias::Yes).then(|| zeros([outputs], device)),
        }
    }

    /// Applies the convolution to `x`, `[bursts * frames, channels, height, width]`.
    pub fn linear(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        self.call(x, frames, Options::default())
    }

    /// Applies the convolution, adds `addend`, and applies ReLU.
    pub fn add_relu(&self, x: Tensor<4>, frames: usize, addend: Tensor<4>) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(x, frames, Options { addend: Some(addend), activation, ..Options::default() })
    }

    /// Applies the convolution and ReLU.
    pub fn relu(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        self.call(x, frames, Options { activation: Activation::Relu, ..Options::default() })
    }

    /// Applies the convolution with stride 2 in rows and columns.
    pub fn stride2(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        self.call(x, frames, Options { stride: 2, ..Options::default() })
    }

    /// Applies the convolution with stride 2 in rows and columns, and ReLU.
    pub fn stride2_relu(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(x, frames, Options { stride: 2, activation, ..Options::default() })
    }

    fn call(&self, x: Tensor<4>, frames: usize, options: Options) -> Tensor<4> {
        let weight = self.weight.val();
        let bias = bias_or_zeros(self.bias.as_ref(), &weight);
        conv_3d(&[x], weight, bias, frames, options)
    }
}
