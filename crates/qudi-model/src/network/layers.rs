//! Layers that several blocks use.

pub(super) mod attention;
pub(super) mod dense_block;
pub(super) mod embedding;
pub(super) mod resample;

use burn::module::{Module, Param, ParamId};
use burn::tensor::{Device, Tensor};
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::group_norm::{self, Norm, group_norm};

/// The factor of a last layer's output that corrects a flow, in cells. Adam moves all weights by the same
/// amount: the sum of a whole layer's would jump.
pub(super) const FLOW_CORRECTION: f32 = 0.1;

/// The factor of a last layer's output that corrects an image, in sigmas of the merged frame's noise.
pub(super) const CORRECTION: f32 = 0.3;

/// A convolution of frames one by one.
#[derive(Module, Debug)]
pub(super) struct Conv2d {
    /// `[outputs, inputs, rows, columns]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Option<Param<Tensor<1>>>,
}

/// A convolution over the frames of bursts.
#[derive(Module, Debug)]
pub(super) struct Conv3d {
    /// `[outputs, inputs, frames, rows, columns]`
    weight: Param<Tensor<5>>,
    /// `[outputs]`
    bias: Option<Param<Tensor<1>>>,
}

/// A matrix and a bias.
#[derive(Module, Debug)]
pub(super) struct Linear {
    /// `[outputs, inputs]`
    weight: Param<Tensor<2>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
}

/// Group normalisation.
#[derive(Module, Debug)]
pub(super) struct GroupNorm {
    /// `[channels]`
    weight: Param<Tensor<1>>,
    /// `[channels]`
    bias: Param<Tensor<1>>,
}

/// Whether a layer has a bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bias {
    Yes,
    No,
}

/// A parameter that takes no memory before it is filled or used: sizes may come from a file that lies.
fn zeros<const D: usize>(shape: [usize; D], device: &Device) -> Param<Tensor<D>> {
    let init = move |device: &Device, require_grad: bool| {
        Tensor::zeros(shape, device).set_require_grad(require_grad)
    };
    Param::uninitialized(ParamId::new(), init, device.clone(), true, shape.into())
}

/// One value for every output of a weight.
fn bias_or_zeros<const D: usize>(bias: Option<&Param<Tensor<1>>>, weight: &Tensor<D>) -> Tensor<1> {
    bias.map_or_else(|| Tensor::zeros([weight.dims()[0]], &weight.device()), Param::val)
}

impl Conv2d {
    /// A layer of zeros; [`super::init_parameters`] gives weights their values by name.
    pub(super) fn zeros(
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

    /// Inserts `more` inputs of zero weight after the first `at` ones.
    pub(super) fn with_zero_inputs(self, at: usize, more: usize) -> Self {
        if more == 0 {
            return self;
        }
        let weight = self.weight.val();
        let [outputs, inputs, rows, columns] = weight.dims();
        let zeros = Tensor::zeros([outputs, more, rows, columns], &weight.device());
        let mut parts = vec![weight.clone().narrow(1, 0, at), zeros];
        if at < inputs {
            parts.push(weight.narrow(1, at, inputs - at));
        }
        Self { weight: Param::from_tensor(Tensor::cat(parts, 1)), ..self }
    }

    /// The number of inputs.
    pub(super) fn inputs(&self) -> usize {
        self.weight.lazy_shape().as_slice()[1]
    }

    /// The sum alone. `inputs` are joined by channel, `[images, channels, height, width]`.
    pub(super) fn linear(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options::default())
    }

    /// The sum and an addend.
    pub(super) fn add(&self, inputs: &[Tensor<4>], addend: Tensor<4>) -> Tensor<4> {
        self.call(inputs, Options { addend: Some(addend), ..Options::default() })
    }

    /// The sum and an addend, then ReLU.
    pub(super) fn add_relu(&self, inputs: &[Tensor<4>], addend: Tensor<4>) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(inputs, Options { addend: Some(addend), activation, ..Options::default() })
    }

    /// The sum, then ReLU.
    pub(super) fn relu(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options { activation: Activation::Relu, ..Options::default() })
    }

    /// The sum at every second row and column.
    pub(super) fn stride2(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.call(inputs, Options { stride: 2, ..Options::default() })
    }

    fn call(&self, inputs: &[Tensor<4>], options: Options) -> Tensor<4> {
        let weight = self.weight.val();
        let bias = bias_or_zeros(self.bias.as_ref(), &weight);
        conv_2d(inputs, weight, bias, options)
    }
}

impl Conv3d {
    /// A layer of zeros with kernel 5 x 5 x 5.
    pub(super) fn zeros([inputs, outputs]: [usize; 2], bias: Bias, device: &Device) -> Self {
        Self {
            weight: zeros([outputs, inputs, 5, 5, 5], device),
            bias: (bias == Bias::Yes).then(|| zeros([outputs], device)),
        }
    }

    /// The sum. `x`: `[bursts * frames, channels, height, width]`.
    pub(super) fn linear(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        self.call(x, frames, Options::default())
    }

    /// The sum and an addend, then ReLU.
    pub(super) fn add_relu(&self, x: Tensor<4>, frames: usize, addend: Tensor<4>) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(x, frames, Options { addend: Some(addend), activation, ..Options::default() })
    }

    /// The sum, then ReLU.
    pub(super) fn relu(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        self.call(x, frames, Options { activation: Activation::Relu, ..Options::default() })
    }

    /// The sum at every second row and column, then ReLU.
    pub(super) fn stride2_relu(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let activation = Activation::Relu;
        self.call(x, frames, Options { stride: 2, activation, ..Options::default() })
    }

    fn call(&self, x: Tensor<4>, frames: usize, options: Options) -> Tensor<4> {
        let weight = self.weight.val();
        let bias = bias_or_zeros(self.bias.as_ref(), &weight);
        conv_3d(&[x], weight, bias, frames, options)
    }
}

impl Linear {
    pub(super) fn zeros([inputs, outputs]: [usize; 2], device: &Device) -> Self {
        Self { weight: zeros([outputs, inputs], device), bias: zeros([outputs], device) }
    }

    /// `x`: `[rows, inputs]`; result `[rows, outputs]`.
    pub(super) fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.weight.val().transpose()) + self.bias.val().unsqueeze()
    }
}

impl GroupNorm {
    pub(super) fn zeros(channels: usize, device: &Device) -> Self {
        Self { weight: zeros([channels], device), bias: zeros([channels], device) }
    }

    /// The norm alone. `x`: `[images, channels, height, width]`.
    pub(super) fn plain(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::None)
    }

    /// The norm and SiLU.
    pub(super) fn silu(&self, x: Tensor<4>) -> Tensor<4> {
        self.call(x, group_norm::Activation::Silu)
    }

    /// The norm, `scale` and `shift` of every burst, and SiLU. `scale`, `shift`: `[bursts, channels]`.
    pub(super) fn film_silu(&self, x: Tensor<4>, scale: Tensor<2>, shift: Tensor<2>) -> Tensor<4> {
        let slope = scale + 1.0;
        let weight = slope.clone() * self.weight.val().unsqueeze();
        let bias = slope * self.bias.val().unsqueeze() + shift;
        let norm = Norm { groups: groups(x.dims()[1]), activation: group_norm::Activation::Silu };
        group_norm(x, weight, bias, norm)
    }

    fn call(&self, x: Tensor<4>, activation: group_norm::Activation) -> Tensor<4> {
        let norm = Norm { groups: groups(x.dims()[1]), activation };
        group_norm(x, self.weight.val().unsqueeze(), self.bias.val().unsqueeze(), norm)
    }
}

/// The largest divisor of the channels that is at most eight.
fn groups(channels: usize) -> usize {
    (1..=8).rev().find(|&groups| channels.is_multiple_of(groups)).unwrap_or(1)
}
