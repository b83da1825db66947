//! Spk2ImgNet: learning to reconstruct dynamic scenes from continuous spike streams (Zhao et al., CVPR 2021),
//! in the size in which it was compared with: ten frames in five blocks of two.

mod align;
mod extractor;
mod method;

use align::{Align, Levels};
use burn::module::{Module, Param};
use burn::tensor::activation::{prelu, sigmoid};
use burn::tensor::{Device, Tensor};
use extractor::Extractor;
use qudi_layers::{Bias, Conv2d, zeros};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Frames that it sees.
pub const FRAMES: usize = 10;

/// The frame that it restores.
pub const RESTORED_FRAME: usize = 5;

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 4;

/// Factor of the images that the network was trained to return.
pub const SCALE: f32 = 0.6;

/// Frames of a block.
pub const BLOCK: usize = 2;
/// Blocks.
pub const BLOCKS: usize = FRAMES / BLOCK;

/// The block that the others are aligned with.
const KEY_BLOCK: usize = 2;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of features.
    pub features: usize,
    /// Channels of each of the four stems.
    pub stem: usize,
    /// Residual blocks.
    pub blocks: usize,
    /// Groups of channels that deformable convolutions take from places of their own.
    pub groups: usize,
}

/// The published sizes.
pub const PUBLISHED: Sizes = Sizes { features: 64, stem: 16, blocks: 10, groups: 8 };

/// The network.
#[derive(Module, Debug)]
pub struct Spk2ImgNet {
    extractor: Extractor,
    masks: Vec<Mask>,
    rec_conv0: Conv2d,
    rec_conv1: Conv2d,
    rec_conv2: Conv2d,
    pcd_align: Align,
}

/// Results that depend on a block of frames alone: windows that share it compute it once.
#[derive(Clone, Debug)]
pub struct Block {
    estimates: Tensor<4>,
    levels: Levels,
}

/// Weight of the aligned features of a block.
#[derive(Module, Debug)]
struct Mask {
    conv0: Conv2d,
    conv1: Conv2d,
    conv2: Conv2d,
    prelu0: Slope,
    prelu1: Slope,
}

/// The slope of what is negative.
#[derive(Module, Debug)]
struct Slope {
    /// `[1]`
    weight: Param<Tensor<1>>,
}

/// Makes a convolution of 3 x 3.
fn conv(sizes: [usize; 2], device: &Device) -> Conv2d {
    Conv2d::zeros(sizes, 3, Bias::Yes, device)
}

impl Spk2ImgNet {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { features, groups, .. } = sizes;
        Self {
            extractor: Extractor::zeros(sizes, device),
            masks: (1..BLOCKS).map(|_| Mask::zeros(features, device)).collect(),
            rec_conv0: conv([BLOCKS * features, 3 * features], device),
            rec_conv1: conv([3 * features, features], device),
            rec_conv2: conv([features, 1], device),
            pcd_align: Align::zeros(features, groups, device),
        }
    }

    /// Returns the name of a parameter in the authors' files.
    pub fn authors_name(name: &str) -> String {
        let name = match name.strip_prefix("masks.") {
            // The key block has none.
            Some(rest) if rest.starts_with(['2', '3']) => {
                format!("mask{}{}", if rest.starts_with('2') { 3 } else { 4 }, &rest[1..])
            }
            Some(rest) => format!("mask{rest}"),
            None => name.to_owned(),
        };
        Align::authors_name(&Extractor::authors_name(&name))
    }

    /// Computes the image at frame 5 times [`SCALE`], and four estimates of it for every block of frames.
    ///
    /// # Shapes
    /// - frames: `[images, 10, height, width]`, sides multiples of 4
    /// - results: `[images, 1, height, width]`, `[images, 5, 4, height, width]`
    pub fn forward(&self, frames: &Tensor<4>) -> (Tensor<4>, Tensor<5>) {
        let pair = |number: usize| frames.clone().narrow(1, number * BLOCK, BLOCK);
        let blocks: [Block; BLOCKS] = std::array::from_fn(|number| self.block(pair(number)));
        let estimates = blocks.iter().map(|block| block.estimates.clone()).collect();
        (self.image(blocks.each_ref()), Tensor::stack(estimates, 1))
    }

    /// Computes what depends on a block of frames alone.
    ///
    /// # Shapes
    /// - frames: `[images, 2, height, width]`
    pub fn block(&self, frames: Tensor<4>) -> Block {
        let (estimates, features) = self.extractor.forward(frames);
        Block { estimates, levels: self.pcd_align.levels(features) }
    }

    /// Computes the image at frame 5, times [`SCALE`], from five consecutive blocks.
    ///
    /// # Shapes
    /// - result: `[images, 1, height, width]`
    pub fn image(&self, blocks: [&Block; BLOCKS]) -> Tensor<4> {
        // All neighbours at once.
        let neighbours: Vec<&Block> =
            (0..BLOCKS).filter(|&block| block != KEY_BLOCK).map(|block| blocks[block]).collect();
        let of = |blocks: &[&Block], level: usize| {
            Tensor::cat(blocks.iter().map(|block| block.levels[level].clone()).collect(), 0)
        };
        let keys = [blocks[KEY_BLOCK]; BLOCKS - 1];
        let aligned = self.pcd_align.forward(
            [0, 1, 2].map(|level| of(&neighbours, level)),
            [0, 1, 2].map(|level| of(&keys, level)),
        );
        let key = &blocks[KEY_BLOCK].levels[0];
        let images = key.dims()[0];
        let masked = self.masks.iter().enumerate().map(|(number, mask)| {
            let aligned = aligned.clone().narrow(0, number * images, images);
            mask.forward(&aligned, key) * aligned
        });
        let mut joined: Vec<_> = masked.collect();
        joined.insert(KEY_BLOCK, key.clone());
        let image = self.rec_conv1.relu(&[self.rec_conv0.relu(&joined)]);
        self.rec_conv2.linear(&[image])
    }
}

impl Mask {
    fn zeros(features: usize, device: &Device) -> Self {
        let same = || conv([features, features], device);
        Self {
            conv0: conv([2 * features, features], device),
            conv1: same(),
            conv2: same(),
            prelu0: Slope { weight: zeros([1], device) },
            prelu1: Slope { weight: zeros([1], device) },
        }
    }

    fn forward(&self, aligned: &Tensor<4>, key: &Tensor<4>) -> Tensor<4> {
        let sloped = |x, slope: &Slope| prelu(x, slope.weight.val());
        let x = self.conv0.linear(&[aligned.clone(), key.clone()]);
        let x = self.conv1.linear(&[sloped(x, &self.prelu0)]);
        sigmoid(self.conv2.linear(&[sloped(x, &self.prelu1)]))
    }
}

/// Computes the terms of the training's loss, `[1]` each: the mean absolute error of the image, and a
/// fiftieth of the estimates' errors.
///
/// # Shapes
/// - image: `[images, 1, height, width]`
/// - estimates: `[images, 5, 4, height, width]`
/// - truth: `[images, 10, height, width]`
pub fn losses(image: Tensor<4>, estimates: Tensor<5>, truth: Tensor<4>) -> [Tensor<1>; 2] {
    let [images, _, height, width] = truth.dims();
    let main = (image / SCALE - truth.clone().narrow(1, RESTORED_FRAME, 1)).abs().mean();
    // The second frame of every block.
    let blocks: Tensor<5> = truth.reshape([images, BLOCKS, BLOCK, height, width]);
    let difference = estimates / SCALE - blocks.narrow(2, 1, 1);
    let each = (BLOCKS * 4) as f32;
    [main, difference.abs().mean() * (0.02 * each)]
}
