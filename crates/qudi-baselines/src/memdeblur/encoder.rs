//! Keys and values of frames, and what is read from memory: the beginning of ResNet-50 (He et al., CVPR 2016)
//! after residual blocks.

use super::Sizes;
use super::batch_norm::{BatchNorm, BatchStatistics};
use super::blocks::Residuals;
use crate::parts::{Corners, renamed, resize};
use burn::module::Module;
use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::pixel_shuffle;
use qudi_layers::{Bias, Conv2d};
use std::slice::from_ref;

/// Expansion of channels at the end of a bottleneck.
const EXPANSION: usize = 4;

/// Encoders and decoders of memories.
#[derive(Module, Debug)]
pub(super) struct Memory {
    key_encoder: Encoder,
    pub(super) value_encoder_mem: Encoder,
    pub(super) value_encoder_feat: Encoder,
    key_proj: Conv2d,
    pub(super) decoder_mem: Decoder,
    pub(super) decoder_feat: Decoder,
}

/// Four times the features at a quarter of the size.
#[derive(Module, Debug)]
pub(super) struct Encoder {
    forward_resblocks: Residuals,
    conv1: Conv2d,
    bn1: BatchNorm,
    layer1: Vec<Bottleneck>,
}

/// Features at four times the size.
#[derive(Module, Debug)]
pub(super) struct Decoder {
    forward_resblocks: Residuals,
    upsample: Conv2d,
}

#[derive(Module, Debug)]
struct Bottleneck {
    conv1: Conv2d,
    bn1: BatchNorm,
    conv2: Conv2d,
    bn2: BatchNorm,
    conv3: Conv2d,
    bn3: BatchNorm,
    downsample: Option<Shortcut>,
}

#[derive(Module, Debug)]
struct Shortcut {
    conv: Conv2d,
    norm: BatchNorm,
}

pub(super) fn authors_name(name: &str) -> String {
    let pairs = [
        ("memory.key_proj.", "memory.key_proj.key_proj."),
        (".upsample.", ".upsample.0."),
        (".downsample.conv.", ".downsample.0."),
        (".downsample.norm.", ".downsample.1."),
    ];
    renamed(name, &pairs)
}

impl Memory {
    pub(super) fn zeros(own: usize, sizes: Sizes, device: &Device) -> Self {
        let features = sizes.features;
        let half = features / 2;
        let decoder = || Decoder {
            forward_resblocks: Residuals::zeros(
                Some(EXPANSION * features),
                features,
                sizes.memory_blocks,
                device,
            ),
            upsample: Conv2d::zeros([features, 16 * features], 3, Bias::Yes, device),
        };
        Self {
            key_encoder: Encoder::zeros(own, own, sizes, device),
            value_encoder_mem: Encoder::zeros(2 * own, half, sizes, device),
            value_encoder_feat: Encoder::zeros(own + features, half, sizes, device),
            key_proj: Conv2d::zeros([EXPANSION * features, features], 3, Bias::Yes, device),
            decoder_mem: decoder(),
            decoder_feat: decoder(),
        }
    }

    /// Encodes; `statistics` are of batches, in training.
    pub(super) fn key(&self, own: Tensor<4>, statistics: Option<&BatchStatistics>) -> Tensor<4> {
        self.key_proj.linear(&[self.key_encoder.forward(&[own], statistics)])
    }
}

impl Encoder {
    fn zeros(inputs: usize, width: usize, sizes: Sizes, device: &Device) -> Self {
        let features = sizes.features;
        let bottleneck = |number: usize| {
            let inputs = if number == 0 { features } else { EXPANSION * features };
            Bottleneck::zeros(inputs, features, device)
        };
        Self {
            forward_resblocks: Residuals::zeros(Some(inputs), width, sizes.memory_blocks, device),
            conv1: Conv2d::zeros([width, features], 7, Bias::Yes, device),
            bn1: BatchNorm::zeros(features, device),
            layer1: (0..sizes.bottlenecks).map(bottleneck).collect(),
        }
    }

    /// Encodes; `statistics` are of batches, in training.
    pub(super) fn forward(
        &self,
        inputs: &[Tensor<4>],
        statistics: Option<&BatchStatistics>,
    ) -> Tensor<4> {
        let x = self.conv1.stride2(&[self.forward_resblocks.forward(inputs)]);
        let x = relu(self.bn1.forward(x, statistics));
        let options = MaxPoolOptions::new([3, 3]).with_stride([2, 2]).with_padding([1, 1]);
        let x = max_pool2d(x, options);
        self.layer1.iter().fold(x, |x, bottleneck| bottleneck.forward(x, statistics))
    }
}

impl Decoder {
    /// Decodes what was read at a quarter of a size, rounded up, to features of this size.
    pub(super) fn forward(&self, x: Tensor<4>, [height, width]: [usize; 2]) -> Tensor<4> {
        let z = self.forward_resblocks.forward(&[x]);
        let [_, _, h, w] = z.dims();
        let drawn = pixel_shuffle(self.upsample.linear(from_ref(&z)), 4);
        let image = drawn + resize(z, [4 * h, 4 * w], Corners::Edges);
        image.narrow(2, 0, height).narrow(3, 0, width)
    }
}

impl Bottleneck {
    fn zeros(inputs: usize, features: usize, device: &Device) -> Self {
        let outputs = EXPANSION * features;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let norm = |channels| BatchNorm::zeros(channels, device);
        Self {
            conv1: conv([inputs, features], 1),
            bn1: norm(features),
            conv2: conv([features, features], 3),
            bn2: norm(features),
            conv3: conv([features, outputs], 1),
            bn3: norm(outputs),
            downsample: (inputs != outputs)
                .then(|| Shortcut { conv: conv([inputs, outputs], 1), norm: norm(outputs) }),
        }
    }

    fn forward(&self, x: Tensor<4>, statistics: Option<&BatchStatistics>) -> Tensor<4> {
        let y = relu(self.bn1.forward(self.conv1.linear(from_ref(&x)), statistics));
        let y = relu(self.bn2.forward(self.conv2.linear(&[y]), statistics));
        let y = self.bn3.forward(self.conv3.linear(&[y]), statistics);
        let x = match &self.downsample {
            Some(shortcut) => shortcut.norm.forward(shortcut.conv.linear(&[x]), statistics),
            None => x,
        };
        relu(y + x)
    }
}
