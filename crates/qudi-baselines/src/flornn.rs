//! FloRNN: unidirectional video denoising by mimicking backward recurrent modules with look-ahead forward
//! ones (Li et al., ECCV 2022), in the form in which it was compared with: frames as three equal channels, no
//! noise map.

mod method;
mod pwcnet;
mod splat;

use crate::parts::{Corners, Residual, masked_warp, renamed, resize, same_flow};
use burn::module::Module;
use burn::tensor::activation::relu;
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor};
use pwcnet::PwcNet;
use qudi_layers::{Bias, Conv2d};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use pwcnet::correlation;
pub use splat::splat_average;

/// Images that flow is found in have sides that are multiples of this.
const FLOW_MULTIPLE: usize = 64;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of images.
    #[serde(skip, default = "published_channels")]
    pub channels: usize,
    /// Channels of features.
    pub features: usize,
    /// Residual blocks of a recurrence.
    pub blocks: usize,
    /// Later frames that it sees.
    #[serde(skip, default = "published_ahead")]
    pub ahead: usize,
    /// Width of the strip around images that motion may leave them by, as a fraction of their sides.
    #[serde(skip, default = "published_border")]
    pub border: f64,
    /// True if it has PWC-Net, and follows motion. Its authors took weights that others had trained, on other
    /// images; networks that are trained here have none.
    #[serde(skip)]
    pub flow: bool,
}

/// The sizes of the authors of QUIVER.
pub const PUBLISHED: Sizes =
    Sizes { channels: 3, features: 64, blocks: 15, ahead: 9, border: 0.1, flow: true };

fn published_channels() -> usize {
    PUBLISHED.channels
}

fn published_ahead() -> usize {
    PUBLISHED.ahead
}

fn published_border() -> f64 {
    PUBLISHED.border
}

/// The network.
#[derive(Module, Debug)]
pub struct FloRnn {
    pwcnet: Option<PwcNet>,
    forward_rnn: Recurrence,
    backward_rnn: Recurrence,
    d: Output,
    channels: usize,
    features: usize,
    ahead: usize,
    border: f64,
}

#[derive(Module, Debug)]
struct Recurrence {
    first_conv: Conv2d,
    resblocks: Vec<Residual>,
}

/// From two states to the image.
#[derive(Module, Debug)]
struct Output {
    first: Conv2d,
    second: Conv2d,
}

impl FloRnn {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { channels, features, blocks, ahead, border, flow } = sizes;
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::No, device);
        let recurrence = || Recurrence {
            first_conv: conv([2 * channels + features, features]),
            resblocks: (0..blocks).map(|_| Residual::zeros(features, Bias::No, device)).collect(),
        };
        Self {
            pwcnet: flow.then(|| PwcNet::zeros(device)),
            forward_rnn: recurrence(),
            backward_rnn: recurrence(),
            d: Output {
                first: conv([2 * features, 2 * features]),
                second: conv([2 * features, channels]),
            },
            channels,
            features,
            ahead,
            border,
        }
    }

    /// Returns the channels of images.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Returns the name of a parameter in the authors' files.
    pub fn authors_name(name: &str) -> String {
        let name = match name.strip_prefix("d.") {
            Some(rest) => {
                format!("d.{}", renamed(rest, &[("first.", "convs.0."), ("second.", "convs.2.")]))
            }
            None => name.to_owned(),
        };
        PwcNet::authors_name(&name)
    }

    /// Computes the flow from `from` to `to`, without gradient: `warp(to, flow)` resembles `from`. None for a
    /// network without PWC-Net.
    ///
    /// # Shapes
    /// - from, to: `[images, 3, height, width]`
    /// - result: `[images, 2, height, width]`, x before y, in pixels
    pub fn flow(&self, from: &Tensor<4>, to: &Tensor<4>) -> Option<Tensor<4>> {
        let pwcnet = self.pwcnet.as_ref()?;
        let [_, _, height, width] = from.dims();
        let size = [height, width];
        let padded = size.map(|side| side.next_multiple_of(FLOW_MULTIPLE));
        let prepared = |image: &Tensor<4>| resize(image.clone().detach(), padded, Corners::Edges);
        let flow = pwcnet.forward(prepared(from), prepared(to)).detach();
        let factor = |axis: usize| pwcnet::FLOW_SCALE * size[axis] as f32 / padded[axis] as f32;
        let scale = same_flow([factor(1), factor(0)], &from.device());
        Some(resize(flow, size, Corners::Edges) * scale)
    }

    /// Computes the flows from each frame to the next; none for a network without PWC-Net.
    pub fn flows(&self, frames: &[Tensor<4>]) -> Vec<Tensor<4>> {
        frames.windows(2).filter_map(|pair| self.flow(&pair[0], &pair[1])).collect()
    }

    /// Returns the number of frames that it sees to restore the second of them.
    pub fn window(&self) -> usize {
        self.ahead + 2
    }

    /// Restores the second frame of a window.
    ///
    /// # Shapes
    /// - window: [`window`](Self::window) frames, `[images, channels, height, width]` each
    /// - flows: from each frame to the next, as [`flow`](Self::flow) finds them; none for a network without
    ///   PWC-Net
    /// - result: `[images, channels, height, width]`
    pub fn forward(&self, window: &[Tensor<4>], flows: &[Tensor<4>]) -> Tensor<4> {
        let [images, _, height, width] = window[0].dims();
        let strip = [height, width].map(|side| (self.border * side as f64) as usize);
        let around = [(0, 0), (0, 0), (strip[0], strip[0]), (strip[1], strip[1])];
        let expand = |image: Tensor<4>| image.pad(around, PadMode::Constant(0.0));
        let crop = |image: Tensor<4>| image.narrow(2, strip[0], height).narrow(3, strip[1], width);
        let device = window[0].device();
        let state = Tensor::zeros([images, self.features, height, width], &device);
        let mut backward = self.backward_rnn.forward(&window[0], state.clone());
        let mut along = Vec::with_capacity(flows.len());
        for (number, image) in window.iter().enumerate().skip(1) {
            if let Some(flow) = flows.get(number - 1) {
                let flow = expand(flow.clone());
                let splatted = splat_average(expand(backward), flow.clone());
                backward = crop(splatted.clone());
                along.push((splatted, flow));
            }
            backward = self.backward_rnn.forward(image, backward);
        }
        // Back along the flow, from the last frame to the second.
        let ones = Tensor::ones([1, 1, height, width], &device);
        let outside = expand(ones).neg() + 1.0;
        let mimicked = along.iter().skip(1).rev().fold(backward, |state, (around, flow)| {
            let whole = around.clone() * outside.clone() + expand(state);
            crop(masked_warp(whole, flow.clone()))
        });
        let mut forward = self.forward_rnn.forward(&window[0], state);
        if let Some(flow) = self.flow(&window[1], &window[0]) {
            forward = masked_warp(forward, flow);
        }
        self.d.forward(self.forward_rnn.forward(&window[1], forward), mimicked)
    }
}

impl Recurrence {
    /// Returns the next state; the noise map is zero.
    fn forward(&self, image: &Tensor<4>, state: Tensor<4>) -> Tensor<4> {
        let x = self.first_conv.linear(&[image.clone(), image.zeros_like(), state]);
        self.resblocks.iter().fold(x, |x, block| block.forward(x))
    }
}

impl Output {
    fn forward(&self, forward: Tensor<4>, backward: Tensor<4>) -> Tensor<4> {
        self.second.linear(&[relu(self.first.linear(&[forward, backward]))])
    }
}

/// Computes the loss of training, `[1]`: half the sum of squared errors of the second frame, over bursts.
///
/// # Shapes
/// - x, truth: `[bursts, channels, height, width]`: second frames
pub fn loss(x: Tensor<4>, truth: Tensor<4>) -> Tensor<1> {
    let error = x - truth;
    let bursts = error.dims()[0];
    error.powi_scalar(2).sum() / (2 * bursts) as f32
}
