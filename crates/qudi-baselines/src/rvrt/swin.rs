//! Layers in shifted windows (Liu et al., "Swin transformer", ICCV 2021).

use super::window::Windows;
use crate::parts::{LayerNorm, renamed};
use burn::module::{Module, Param};
use burn::tensor::activation::{gelu, softmax};
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, Linear, zeros};

/// Heads of the attention.
const HEADS: usize = 6;

/// Side of a window.
pub(super) const SIDE: usize = 8;

/// Sizes of a stage.
#[derive(Clone, Copy, Debug)]
pub(super) struct StageSizes {
    pub(super) inputs: usize,
    pub(super) width: usize,
    /// Frames of a window.
    pub(super) frames: usize,
    pub(super) blocks: usize,
}

/// A convolution, and blocks between two norms.
#[derive(Module, Debug)]
pub(super) struct Stage {
    conv: Conv2d,
    before: LayerNorm,
    blocks: Vec<Block>,
    after: LayerNorm,
}

/// Two layers, the second in shifted windows, and a residual.
#[derive(Module, Debug)]
struct Block {
    layers: Vec<SwinLayer>,
    linear: Linear,
}

/// Attention in windows and a perceptron, each with a norm and a residual.
#[derive(Module, Debug)]
pub(crate) struct SwinLayer {
    norm1: LayerNorm,
    norm2: LayerNorm,
    attn: Attention,
    mlp: Mlp,
    /// Frames of a window.
    frames: usize,
    shifted: bool,
}

#[derive(Module, Debug)]
struct Attention {
    /// `[offsets, heads]`
    relative_position_bias_table: Param<Tensor<2>>,
    qkv_self: Linear,
    proj: Linear,
}

/// Two layers on the channels of every pixel.
#[derive(Module, Debug)]
pub(super) struct Mlp {
    fc1: Linear,
    fc2: Linear,
}

impl Stage {
    pub(super) fn zeros(sizes: StageSizes, device: &Device) -> Self {
        let StageSizes { inputs, width, frames, blocks } = sizes;
        let block = |_| Block {
            layers: [false, true]
                .map(|shifted| SwinLayer::zeros(width, frames, shifted, device))
                .into(),
            linear: Linear::zeros([width, width], device),
        };
        Self {
            conv: Conv2d::zeros([inputs, width], 3, Bias::Yes, device),
            before: LayerNorm::zeros(width, device),
            blocks: (0..blocks).map(block).collect(),
            after: LayerNorm::zeros(width, device),
        }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let pairs = [
            (".conv.", ".main.1."),
            (".before.", ".main.3."),
            (".blocks.", ".main.5."),
            (".after.", ".main.7."),
            (".layers.", ".residual_group.blocks."),
        ];
        let has_stage = ["feat_extract.6.", "backbone.", "reconstruction."];
        if has_stage.iter().any(|stage| name.starts_with(stage)) {
            return renamed(name, &pairs);
        }
        name.to_owned()
    }

    /// Computes features of frames that attend to each other in windows.
    ///
    /// # Shapes
    /// - x: `[bursts * frames, inputs, height, width]`
    /// - result: `[bursts * frames, width, height, width]`
    pub(super) fn forward(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let x = self.before.forward(self.conv.linear(&[x]));
        let x = self.blocks.iter().fold(x, |x, block| {
            let inner = block.layers.iter().fold(x.clone(), |x, layer| layer.forward(x, frames));
            x + block.linear.on_channels(inner)
        });
        self.after.forward(x)
    }
}

impl SwinLayer {
    pub(crate) fn zeros(width: usize, frames: usize, shifted: bool, device: &Device) -> Self {
        let offsets = (2 * frames - 1) * (2 * SIDE - 1) * (2 * SIDE - 1);
        Self {
            norm1: LayerNorm::zeros(width, device),
            norm2: LayerNorm::zeros(width, device),
            attn: Attention {
                relative_position_bias_table: zeros([offsets, HEADS], device),
                qkv_self: Linear::zeros([width, 3 * width], device),
                proj: Linear::zeros([width, width], device),
            },
            mlp: Mlp::zeros(width, 2 * width, device),
            frames,
            shifted,
        }
    }

    /// Applies the layer; `x` is `[bursts * frames, channels, height, width]`.
    pub(crate) fn forward(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let [_, _, height, width] = x.dims();
        let windows = Windows::new([frames, height, width], self.frames, self.shifted);
        let attended = self.attn.forward(windows.padded(self.norm1.forward(x.clone())), &windows);
        let x = x + windows.cropped(attended);
        x.clone() + self.mlp.forward(self.norm2.forward(x))
    }
}

impl Attention {
    fn forward(&self, x: Tensor<4>, windows: &Windows) -> Tensor<4> {
        let channels = x.dims()[1];
        let size = channels / HEADS;
        let cells = windows.cells();
        // [windows, 3 * channels, cells]
        let qkv = windows.split(self.qkv_self.on_channels(x));
        let count = qkv.dims()[0];
        let third = |number: usize| -> Tensor<4> {
            let part = qkv.clone().narrow(1, number * channels, channels);
            part.reshape([count, HEADS, size, cells])
        };
        let scale = (size as f32).powf(-0.5);
        let scores = (third(0) * scale).transpose().matmul(third(1)) + self.bias(windows);
        let scores = windows.masked(scores);
        let mixed = third(2).matmul(softmax(scores, 3).transpose());
        self.proj.on_channels(windows.join(mixed.reshape([count, channels, cells])))
    }

    /// Returns the biases of positions in a window, which are added to the scores, `[1, heads, cells,
    /// cells]`.
    fn bias(&self, windows: &Windows) -> Tensor<4> {
        let cells = windows.cells();
        let table = self.relative_position_bias_table.val();
        let bias = table.clone().select(0, windows.offsets(&table.device()));
        bias.reshape([cells, cells, HEADS]).permute([2, 0, 1]).unsqueeze()
    }
}

impl Mlp {
    pub(super) fn zeros(width: usize, hidden: usize, device: &Device) -> Self {
        Self {
            fc1: Linear::zeros([width, hidden], device),
            fc2: Linear::zeros([hidden, width], device),
        }
    }

    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.fc2.on_channels(gelu(self.fc1.on_channels(x)))
    }
}
