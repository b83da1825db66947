//! Guided deformable attention: from the frames of a clip to where the clip before has them.

use super::swin::Mlp;
use super::{CLIP, Pair, turned};
use crate::parts::{deform_samples, leaky_layers};
use burn::module::Module;
use burn::tensor::activation::{softmax, tanh};
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, Linear};

/// Groups of channels that are taken from places of their own.
const GROUPS: usize = 12;

/// Heads of the attention.
const HEADS: usize = 12;

/// Taps around every place.
const TAPS: usize = 9;

/// Largest offset beyond the flow, in pixels.
const MAX_OFFSET: f32 = 10.0;

/// The attention.
#[derive(Module, Debug)]
pub(crate) struct GuidedAttention {
    conv_offset: Vec<Conv2d>,
    proj_q: Linear,
    proj_k: Linear,
    proj_v: Linear,
    proj: Linear,
    mlp: Mlp,
}

impl GuidedAttention {
    pub(crate) fn zeros(width: usize, middle: usize, device: &Device) -> Self {
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let mut conv_offset = vec![conv([3 * width + 4, middle], 1)];
        conv_offset.extend((0..4).map(|_| conv([middle, middle], 3)));
        conv_offset.push(conv([middle, 4 * TAPS * GROUPS], 1));
        let wide = || Linear::zeros([width, 2 * width], device);
        Self {
            conv_offset,
            proj_q: wide(),
            proj_k: wide(),
            proj_v: wide(),
            proj: Linear::zeros([2 * width, width], device),
            mlp: Mlp::zeros(width, 2 * width, device),
        }
    }

    /// Aligns the clip before with this one, and returns new flows, too. All clips are `[bursts * 2,
    /// channels, height, width]`.
    pub(crate) fn forward(
        &self,
        q: Tensor<4>,
        k: Tensor<4>,
        v: Tensor<4>,
        warped: [Tensor<4>; 2],
        flows: Pair,
    ) -> (Tensor<4>, Pair) {
        let [warped_same, warped_other] = warped;
        let start = vec![q.clone(), warped_same, warped_other, flows[0].clone(), flows[1].clone()];
        let changes = tanh(leaky_layers(&self.conv_offset, start)) * MAX_OFFSET;
        let half = 2 * TAPS * GROUPS;
        let offsets = [0, 1].map(|n: usize| {
            // Offsets are y before x, flow is x before y.
            let around = flows[n].clone().flip([1]).repeat(&[1, TAPS * GROUPS, 1, 1]);
            changes.clone().narrow(1, n * half, half) + around
        });
        let q = self.proj_q.on_channels(q);
        let kv = Tensor::cat(vec![self.proj_k.on_channels(k), self.proj_v.on_channels(v)], 1);
        let x = self.proj.on_channels(attend(q, &kv, &offsets));
        let x = x.clone() + self.mlp.forward(x);
        (x, offsets.map(mean_flow))
    }
}

/// Lets every pixel attend to what the taps see in both frames of the clip before: first in the one of the
/// same place, then in the other.
fn attend(q: Tensor<4>, kv: &Tensor<4>, offsets: &Pair) -> Tensor<4> {
    let [images, channels, height, width] = q.dims();
    let (size, pixels) = (channels / HEADS, height * width);
    let samples = [kv.clone(), turned(kv)]
        .into_iter()
        .zip(offsets)
        .map(|(kv, offset)| deform_samples(kv, offset.clone(), GROUPS));
    let both = Tensor::cat(samples.collect(), 2);
    let of = |first: usize| -> Tensor<5> {
        let part = both.clone().narrow(1, first, channels);
        part.reshape([images, HEADS, size, CLIP * TAPS, pixels])
    };
    let q: Tensor<5> = q.reshape([images, HEADS, size, 1, pixels]);
    let scores = (q * of(0)).sum_dim(2) * (size as f32).powf(-0.5);
    let mixed = (softmax(scores, 3) * of(channels)).sum_dim(3);
    mixed.reshape([images, channels, height, width])
}

/// Returns the mean of all places, as flow.
fn mean_flow(offset: Tensor<4>) -> Tensor<4> {
    let [images, _, height, width] = offset.dims();
    let places: Tensor<5> = offset.reshape([images, TAPS * GROUPS, 2, height, width]);
    places.mean_dim(1).reshape([images, 2, height, width]).flip([1])
}
