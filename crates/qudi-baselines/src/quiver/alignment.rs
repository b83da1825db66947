//! Features over frames, aligned from every frame to the next, and the fusion of two kinds of them.

use super::fourth;
use crate::parts::{deform_conv, frames_from, leaky_layers, warp_zeros};
use burn::module::{Module, Param};
use burn::tensor::activation::{gelu, sigmoid, tanh};
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{avg_pool2, by_burst};
use qudi_layers::{Bias, Conv2d, Conv3d, Linear, zeros};

/// Groups of channels that are taken from places of their own.
const GROUPS: usize = 16;

/// Taps of their kernels.
const TAPS: usize = 9;

/// Largest offset beyond the flow, in pixels.
const MAX_OFFSET: f32 = 10.0;

/// Features at three scales.
#[derive(Module, Debug)]
pub(super) struct Extractor {
    f1: Conv3d,
    f2: Conv3d,
    f3: Conv3d,
}

/// A deformable convolution around flow.
#[derive(Module, Debug)]
pub(super) struct Alignment {
    /// `[features, features, 3, 3]`
    weight: Param<Tensor<4>>,
    /// `[features]`
    bias: Param<Tensor<1>>,
    conv_offset: Vec<Conv2d>,
}

/// Gated layers on channels.
#[derive(Module, Debug)]
pub(crate) struct GatedFusion {
    fc11: Linear,
    fc12: Linear,
    fc2: Linear,
}

impl Extractor {
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        let conv = || Conv3d::zeros([1, features], Bias::Yes, device);
        Self { f1: conv(), f2: conv(), f3: conv() }
    }

    pub(super) fn forward(&self, x: Tensor<4>, frames: usize) -> [Tensor<4>; 3] {
        let half = avg_pool2(x.clone());
        [
            self.f1.linear(x.clone(), frames),
            self.f2.stride2(x, frames),
            self.f3.stride2(half, frames),
        ]
    }
}

impl Alignment {
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        let outputs = 3 * TAPS * GROUPS;
        let sizes =
            [[2 * features + 2, features], [features; 2], [features; 2], [features, outputs]];
        Self {
            weight: zeros([features, features, 3, 3], device),
            bias: zeros([features], device),
            conv_offset: sizes.map(|sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device)).into(),
        }
    }

    /// Aligns every frame but the last of every burst with the next; zeros come first.
    pub(super) fn frames(&self, x: Tensor<4>, flow: &Tensor<4>, frames: usize) -> Tensor<4> {
        let [images, channels, height, width] = x.dims();
        let before = frames_from(&x, frames, 0, frames - 1);
        let after = frames_from(&x, frames, 1, frames - 1);
        let warped = warp_zeros(before.clone(), flow.clone());
        // One pair by itself: the taps of all would fill the memory.
        let one = |x: &Tensor<4>, number: usize| x.clone().narrow(0, number, 1);
        let pairs = (0..before.dims()[0]).map(|number| {
            let [x, warped, after, flow] = [&before, &warped, &after, flow].map(|x| one(x, number));
            self.align(x, [warped, after], flow)
        });
        let aligned = by_burst(Tensor::cat(pairs.collect(), 0), frames - 1);
        let first = aligned.clone().narrow(1, 0, 1).zeros_like();
        Tensor::cat(vec![first, aligned], 1).reshape([images, channels, height, width])
    }

    fn align(&self, x: Tensor<4>, [warped, current]: [Tensor<4>; 2], flow: Tensor<4>) -> Tensor<4> {
        let z = leaky_layers(&self.conv_offset, vec![warped, current, flow.clone()]);
        let (offsets, masks) = (2 * TAPS * GROUPS, TAPS * GROUPS);
        // Offsets are y before x, flow is x before y.
        let around = flow.flip([1]).repeat(&[1, TAPS * GROUPS, 1, 1]);
        let offset = tanh(z.clone().narrow(1, 0, offsets)) * MAX_OFFSET + around;
        let mask = sigmoid(z.narrow(1, offsets, masks));
        deform_conv(x, offset, mask, self.weight.val(), self.bias.val())
    }
}

impl GatedFusion {
    pub(crate) fn zeros(features: usize, device: &Device) -> Self {
        let double = 2 * features;
        Self {
            fc11: Linear::zeros([double, double], device),
            fc12: Linear::zeros([double, double], device),
            fc2: Linear::zeros([double, features], device),
        }
    }

    pub(crate) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let gate = gelu(self.fc11.on_channels(x.clone()));
        self.fc2.on_channels(gate * self.fc12.on_channels(x))
    }
}

/// Returns the image at half and at a quarter of its size.
pub(super) fn smaller(x: &Tensor<4>) -> [Tensor<4>; 2] {
    [avg_pool2(x.clone()), fourth(x.clone())]
}
