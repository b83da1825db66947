//! The maps of a window of frames to one, by attention between channels.

use crate::parts::{Depthwise, renamed};
use burn::module::Module;
use burn::tensor::activation::softmax;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d};

/// Smallest norm that channels are divided by.
const MIN_NORM: f32 = 1e-12;

/// The merge.
#[derive(Module, Debug)]
pub(super) struct Merge {
    conv: Conv2d,
    spat_att: Attention,
    conv1x1: Conv2d,
}

/// Attention between channels.
#[derive(Module, Debug)]
struct Attention {
    depthwise: Depthwise,
    qkv: Conv2d,
    project_out: Conv2d,
}

impl Merge {
    pub(super) fn zeros(frames: usize, width: usize, device: &Device) -> Self {
        let all = frames * width;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::No, device);
        Self {
            conv: conv([all, all], 3),
            spat_att: Attention {
                depthwise: Depthwise::zeros(all, device),
                qkv: conv([all, 3 * all], 1),
                project_out: conv([all, all], 1),
            },
            conv1x1: conv([all, width], 1),
        }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let pairs = [
            ("spat_att.depthwise.", "spat_att.get_qkv.0."),
            ("spat_att.qkv.", "spat_att.get_qkv.1."),
        ];
        renamed(name, &pairs)
    }

    /// Merges the maps of a window, the restored frame's last.
    pub(super) fn forward(&self, window: &[Tensor<4>]) -> Tensor<4> {
        let y = self.conv.linear(window);
        self.conv1x1.linear(&[self.spat_att.forward(y.clone()) + y])
    }
}

impl Attention {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [images, channels, height, width] = x.dims();
        let qkv = self.qkv.linear(&[self.depthwise.forward(x)]);
        let qkv: Tensor<3> = qkv.reshape([images, 3 * channels, height * width]);
        let third = |number: usize| qkv.clone().narrow(1, number * channels, channels);
        let unit = |x: Tensor<3>| {
            let norm = x.clone().powi_scalar(2).sum_dim(2).sqrt().clamp_min(MIN_NORM);
            x / norm
        };
        let weights = softmax(unit(third(0)).matmul(unit(third(1)).transpose()), 2);
        let mixed = weights.matmul(third(2)).reshape([images, channels, height, width]);
        self.project_out.linear(&[mixed])
    }
}
