//! MemDeblur: multi-scale memory-based video deblurring (Ji and Yao, CVPR 2022), in the form in which it was
//! compared with: frames as three equal channels.

mod bank;
mod batch_norm;
mod blocks;
mod encoder;
mod method;

use crate::parts::{
    ConvTranspose, Corners, bursts_of, charbonnier, dense_blocks_renamed, frame, leaky, renamed,
    resize,
};
use bank::Bank;
use blocks::{Down, Residuals};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use encoder::Memory;
use qudi_layers::{Bias, Conv2d};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use batch_norm::BatchStatistics;

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 4;

/// Downscaling of each pass's images, and its stride of frames that are stored.
const PASSES: [(usize, usize); 3] = [(4, 1), (2, 2), (1, 5)];

/// Stride of the frames that the pass backward stores, and the first of them in inference.
pub const BACKWARD_STRIDE: usize = 5;
const BACKWARD_START: usize = 2;

/// Frames whose positions stay in a memory in inference.
const MEMORY_FRAMES: usize = 5;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of images.
    #[serde(skip, default = "published_channels")]
    pub channels: usize,
    /// Channels of features.
    pub features: usize,
    /// Residual blocks of the passes forward.
    pub forward_blocks: usize,
    /// Residual blocks of the pass backward.
    pub backward_blocks: usize,
    /// Residual blocks of encoders and decoders.
    pub memory_blocks: usize,
    /// Bottlenecks of encoders.
    pub bottlenecks: usize,
    /// Entries that are read in inference.
    #[serde(skip, default = "published_top")]
    pub top: usize,
}

/// The published sizes.
pub const PUBLISHED: Sizes = Sizes {
    channels: 3,
    features: 64,
    forward_blocks: 30,
    backward_blocks: 10,
    memory_blocks: 2,
    bottlenecks: 3,
    top: 20,
};

fn published_channels() -> usize {
    PUBLISHED.channels
}

fn published_top() -> usize {
    PUBLISHED.top
}

/// Mode of memories and normalisations.
#[derive(Clone, Copy, Debug)]
pub enum Mode<'a> {
    /// Training: memories keep and return everything. Normalisations take the statistics of the batch, and
    /// move these; the running ones where none are given.
    Training(Option<&'a BatchStatistics>),
    /// Inference: memories keep the last frames and return the most similar entries. Normalisations take
    /// running statistics.
    Use,
}

impl<'a> Mode<'a> {
    fn statistics(self) -> Option<&'a BatchStatistics> {
        match self {
            Self::Training(statistics) => statistics,
            Self::Use => None,
        }
    }
}

/// The network.
#[derive(Module, Debug)]
pub struct MemDeblur {
    downsampling: Downsampling,
    upsampling: Upsampling,
    forward_input_convs: Vec<Conv2d>,
    forward_resblocks: Residuals,
    backward_resblocks: Residuals,
    fusion: Conv2d,
    /// In the files, but not used.
    conv_hr: Conv2d,
    /// In the files, but not used.
    conv_last: Conv2d,
    memory: Memory,
    channels: usize,
    features: usize,
    top: usize,
}

/// Features of a frame at a quarter of its size.
#[derive(Module, Debug)]
struct Downsampling {
    first: Conv2d,
    second: Down,
    third: Down,
}

/// From features to an image of four times the size.
#[derive(Module, Debug)]
struct Upsampling {
    first: ConvTranspose,
    second: ConvTranspose,
    third: Conv2d,
}

/// A frame at one scale.
struct View {
    image: Tensor<4>,
    /// Its own features.
    own: Tensor<4>,
    /// Where memories find it.
    key: Tensor<4>,
}

impl MemDeblur {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { channels, features, .. } = sizes;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let own = 16 * channels;
        // A frame's own features, another frame's, the state's, and what two memories return.
        let input = |pass: usize| {
            let coarser = if pass > 0 { own } else { 0 };
            conv([2 * own + 4 * features + coarser, features], 3)
        };
        Self {
            downsampling: Downsampling {
                first: conv([channels, channels], 5),
                second: Down::zeros(channels, features / 4, device),
                third: Down::zeros(4 * channels, features * 3 / 8, device),
            },
            upsampling: Upsampling {
                first: ConvTranspose::zeros([features, features / 2], 3, device),
                second: ConvTranspose::zeros([features / 2, features / 4], 3, device),
                third: conv([features / 4, channels], 5),
            },
            forward_input_convs: (0..PASSES.len()).map(input).collect(),
            forward_resblocks: Residuals::zeros(None, features, sizes.forward_blocks, device),
            backward_resblocks: Residuals::zeros(
                Some(2 * own + 2 * features),
                features,
                sizes.backward_blocks,
                device,
            ),
            fusion: conv([2 * features, features], 1),
            conv_hr: conv([features, features], 3),
            conv_last: conv([features, channels], 3),
            memory: Memory::zeros(own, sizes, device),
            channels,
            features,
            top: sizes.top,
        }
    }

    /// Returns the channels of images.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Returns the name of a parameter, or of a running statistic, in the authors' files.
    pub fn authors_name(name: &str) -> String {
        let name = renamed(
            name,
            &[
                ("downsampling.first.", "downsampling.0."),
                ("downsampling.second.", "downsampling.1."),
                ("downsampling.third.", "downsampling.2."),
                ("upsampling.first.", "upsampling.0."),
                ("upsampling.second.", "upsampling.2."),
                ("upsampling.third.", "upsampling.4."),
            ],
        );
        let name = dense_blocks_renamed(&name);
        let name = match name.strip_prefix("forward_input_convs.") {
            Some(rest) => {
                let (number, rest) = rest.split_once('.').unwrap_or((rest, ""));
                format!("forward_input_convs.{number}.0.{rest}")
            }
            None => name,
        };
        encoder::authors_name(&Residuals::authors_name(&name))
    }

    /// Restores every frame of bursts at a quarter, at half and at the full size: `[bursts * frames,
    /// channels, h, w]` with sides rounded up to multiples of 4.
    ///
    /// # Shapes
    /// - x: `[bursts * frames, channels, height, width]`, sides multiples of 4
    pub fn forward(&self, x: &Tensor<4>, frames: usize, mode: Mode<'_>) -> [Tensor<4>; 3] {
        let views = (0..frames).map(|i| self.view(frame(x, frames, i), mode));
        let views: Vec<View> = views.collect();
        let (top, stored) = match mode {
            Mode::Training(_) => (usize::MAX, usize::MAX),
            Mode::Use => (self.top, MEMORY_FRAMES),
        };
        let mut back = Bank::new(top, stored);
        let future = self.backward(&views, &mut back, mode);
        let mut ahead = Bank::new(top, stored);
        let mut coarser: Option<Vec<Tensor<4>>> = None;
        PASSES.map(|pass| {
            let banks = (&back, &mut ahead);
            let outputs = self.pass(pass, &views, &future, banks, coarser.as_deref(), mode);
            coarser = Some(outputs.clone());
            bursts_of(outputs)
        })
    }

    fn view(&self, image: Tensor<4>, mode: Mode<'_>) -> View {
        let own = self.downsampling.forward(image.clone());
        let key = self.memory.key(own.clone(), mode.statistics());
        View { image, own, key }
    }

    /// Computes the state at every frame in the pass from the last frame to the first.
    fn backward(&self, views: &[View], back: &mut Bank, mode: Mode<'_>) -> Vec<Tensor<4>> {
        let last = views.len() - 1;
        let mut states: Vec<Tensor<4>> = Vec::with_capacity(views.len());
        for (i, view) in views.iter().enumerate().rev() {
            let [_, own, h, w] = view.own.dims();
            let mut inputs = vec![view.own.clone()];
            match states.last() {
                None => inputs.push(nothing(&view.own, own + 2 * self.features)),
                Some(state) => {
                    let read = back.read(&view.key).remove(0);
                    inputs.push(views[i + 1].own.clone());
                    inputs.push(self.memory.decoder_feat.forward(read, [h, w]));
                    inputs.push(state.clone());
                }
            }
            let state = self.backward_resblocks.forward(&inputs);
            let stores = match mode {
                Mode::Training(_) => i % BACKWARD_STRIDE == 0,
                Mode::Use => i % BACKWARD_STRIDE == BACKWARD_START || i == last,
            };
            if stores {
                let inputs = [view.own.clone(), state.clone()];
                let value = self.memory.value_encoder_feat.forward(&inputs, mode.statistics());
                back.store(view.key.clone(), vec![value]);
            }
            states.push(state);
        }
        states.reverse();
        states
    }

    /// Restores the frames at one scale, from the first to the last. The first bank belongs to the pass
    /// backward.
    fn pass(
        &self,
        (scale, every): (usize, usize),
        views: &[View],
        future: &[Tensor<4>],
        (back, ahead): (&Bank, &mut Bank),
        coarser: Option<&[Tensor<4>]>,
        mode: Mode<'_>,
    ) -> Vec<Tensor<4>> {
        let number = PASSES.iter().position(|pass| pass.0 == scale).expect("a scale");
        let memory = &self.memory;
        let mut outputs = Vec::with_capacity(views.len());
        let mut before: Option<(Tensor<4>, Tensor<4>)> = None;
        for (i, full) in views.iter().enumerate() {
            let smaller;
            let View { image, own, key } = if scale == 1 {
                full
            } else {
                let [_, _, height, width] = full.image.dims();
                let size = [height, width].map(|side| (side / scale).next_multiple_of(MULTIPLE));
                smaller = self.view(resize(full.image.clone(), size, Corners::Edges), mode);
                &smaller
            };
            let [_, channels, h, w] = own.dims();
            let read = back.read(key).remove(0);
            let mut inputs = vec![own.clone(), memory.decoder_feat.forward(read, [h, w])];
            if let Some(coarser) = coarser {
                let [_, _, height, width] = image.dims();
                let image = resize(coarser[i].clone(), [height, width], Corners::Edges);
                inputs.push(self.downsampling.forward(image));
            }
            match before {
                None => inputs.push(nothing(own, channels + 3 * self.features)),
                Some((other, state)) => {
                    let mut read = ahead.read(key);
                    let (features, images) = (read.remove(1), read.remove(0));
                    inputs.push(other);
                    inputs.push(memory.decoder_feat.forward(features, [h, w]));
                    inputs.push(state);
                    inputs.push(memory.decoder_mem.forward(images, [h, w]));
                }
            }
            let input = leaky(self.forward_input_convs[number].linear(&inputs));
            let state = self.forward_resblocks.forward(&[input]);
            let later = resize(future[i].clone(), [h, w], Corners::Edges);
            let fused = leaky(self.fusion.linear(&[later, state.clone()]));
            let output = self.upsampling.forward(fused) + image.clone();
            if i % every == 0 {
                let drawn = self.downsampling.forward(output.clone());
                let statistics = mode.statistics();
                let images = memory.value_encoder_mem.forward(&[own.clone(), drawn], statistics);
                let inputs = [own.clone(), state.clone()];
                let features = memory.value_encoder_feat.forward(&inputs, statistics);
                ahead.store(key.clone(), vec![images, features]);
            }
            before = Some((own.clone(), state));
            outputs.push(output);
        }
        outputs
    }
}

impl Downsampling {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.third.forward(self.second.forward(self.first.linear(&[x])))
    }
}

impl Upsampling {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = leaky(self.first.forward(x));
        self.third.linear(&[leaky(self.second.forward(x))])
    }
}

/// Returns zeros with another number of channels.
fn nothing(like: &Tensor<4>, channels: usize) -> Tensor<4> {
    let [images, _, height, width] = like.dims();
    Tensor::zeros([images, channels, height, width], &like.device())
}

/// Computes the loss of training: Charbonnier's at all three scales, the coarsest first, `[1]` each.
///
/// # Shapes
/// - truth: `[bursts * frames, channels, height, width]`
pub fn losses(outputs: [Tensor<4>; 3], truth: &Tensor<4>) -> [Tensor<1>; 3] {
    outputs.map(|output| {
        let [_, _, height, width] = output.dims();
        let truth = resize(truth.clone(), [height, width], Corners::Edges);
        charbonnier(output, truth)
    })
}
