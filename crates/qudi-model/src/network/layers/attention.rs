//! Self-attention over the cells of a frame, or over the frames of a cell.

use burn::module::Module;
use burn::tensor::activation::softmax;
use burn::tensor::{Device, Tensor};
use qudi_kernels::attention;
use qudi_layers::{Bias, Conv2d, GroupNorm};

/// Self-attention with a residual.
#[derive(Module, Debug)]
pub(in crate::network) struct Attention {
    norm: GroupNorm,
    qkv: Conv2d,
    project: Conv2d,
}

impl Attention {
    pub(in crate::network) fn zeros(channels: usize, device: &Device) -> Self {
        Self {
            norm: GroupNorm::zeros(channels, device),
            qkv: Conv2d::zeros([channels, 3 * channels], 1, Bias::Yes, device),
            project: Conv2d::zeros([channels, channels], 1, Bias::Yes, device),
        }
    }

    /// Every cell attends to the cells of its frame. `x`: `[images, channels, h, w]`.
    pub(in crate::network) fn spatial(&self, x: Tensor<4>) -> Tensor<4> {
        let qkv = self.qkv.linear(&[self.norm.plain(x.clone())]);
        self.project.add(&[attention(qkv)], x)
    }

    /// Every cell attends to the same cell of the other frames.
    pub(in crate::network) fn temporal(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let [images, channels, h, w] = x.dims();
        let bursts = images / frames;
        let qkv = self.qkv.linear(&[self.norm.plain(x.clone())]);
        let qkv = qkv.reshape([bursts, frames, 3 * channels, h * w]);
        let part = |n: usize| {
            let part = qkv.clone().narrow(2, n * channels, channels); // [B, N, C, cells]
            part.permute([0, 3, 1, 2]).reshape([bursts * h * w, frames, channels])
        };
        let mixed = attend(part(0), part(1), part(2)); // [B * cells, N, C]
        let mixed = mixed.reshape([bursts, h * w, frames, channels]).permute([0, 2, 3, 1]);
        self.project.add(&[mixed.reshape([images, channels, h, w])], x)
    }
}

/// `softmax(q k^T / sqrt(C)) v`, all `[batch, places, C]`.
fn attend(q: Tensor<3>, k: Tensor<3>, v: Tensor<3>) -> Tensor<3> {
    let scale = (q.dims()[2] as f32).sqrt().recip();
    softmax((q * scale).matmul(k.swap_dims(1, 2)), 2).matmul(v)
}
