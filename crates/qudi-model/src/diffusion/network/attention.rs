//! Self-attention over the cells of a frame.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::attention;
use qudi_layers::{Bias, Conv2d, GroupNorm};

/// Self-attention with a residual.
#[derive(Module, Debug)]
pub(crate) struct Attention {
    norm: GroupNorm,
    qkv: Conv2d,
    project: Conv2d,
}

impl Attention {
    pub(crate) fn zeros(channels: usize, device: &Device) -> Self {
        Self {
            norm: GroupNorm::zeros(channels, device),
            qkv: Conv2d::zeros([channels, 3 * channels], 1, Bias::Yes, device),
            project: Conv2d::zeros([channels, channels], 1, Bias::Yes, device),
        }
    }

    /// Applies attention: every cell attends to the cells of its frame. `x`: `[images, channels, h, w]`.
    pub(crate) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let qkv = self.qkv.linear(&[self.norm.plain(x.clone())]);
        self.project.add(&[attention(qkv)], x)
    }
}
