//! RVRT: recurrent video restoration transformer with guided deformable attention (Liang et al., NeurIPS
//! 2022), in the size in which it was compared with.

mod guided;
mod method;
mod swin;
mod window;

use crate::parts::{
    SpyNet, bursts_of, every_second, frame, frames_from, leaky, quarter, renamed, warp_zeros,
};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use guided::GuidedAttention;
use qudi_layers::resample::{by_burst, pixel_shuffle};
use qudi_layers::{Bias, Conv2d};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use swin::{Stage, StageSizes};

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 4;

/// Frames that are propagated together; bursts are multiples of it.
pub const CLIP: usize = 2;

/// Mean and standard deviation of the channels that flow is found in.
const CHANNELS: [[f32; 2]; 3] = [[0.485, 0.229], [0.456, 0.224], [0.406, 0.225]];

/// The propagations in their order, and whether each goes backward.
const PROPAGATIONS: [(&str, bool); 4] =
    [("backward_1", true), ("forward_1", false), ("backward_2", true), ("forward_2", false)];

/// Channels before the upsampling, and inside the search for offsets.
const MIDDLE_WIDTH: usize = 64;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of images: 1 or 3; 1 of networks that are trained here.
    #[serde(skip, default = "published_channels")]
    pub channels: usize,
    /// Channels of features, a multiple of 12.
    pub features: usize,
    /// Blocks of every propagation.
    pub blocks: usize,
}

/// The sizes of the authors of QUIVER, for gray images.
pub const PUBLISHED: Sizes = Sizes { channels: 1, features: 144, blocks: 2 };

fn published_channels() -> usize {
    PUBLISHED.channels
}

/// The network.
#[derive(Module, Debug)]
pub struct Rvrt {
    spynet: SpyNet,
    feat_extract: Extractor,
    backbone: Vec<Stage>,
    deform_align: Vec<GuidedAttention>,
    reconstruction: Stage,
    conv_before_upsampler: Conv2d,
    upsampler: Vec<Conv2d>,
    conv_last: Conv2d,
    channels: usize,
}

/// Features at a quarter of the size.
#[derive(Module, Debug)]
struct Extractor {
    first: Conv2d,
    second: Conv2d,
    stage: Stage,
}

/// The flows of two frames to two others, each `[bursts * 2, 2, h, w]`: to the frame of the same place in the
/// clip before, and to the other one.
type Pair = [Tensor<4>; 2];

impl Rvrt {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { channels, features, blocks } = sizes;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let stage = |inputs: usize, frames: usize, blocks: usize| {
            let sizes = StageSizes { inputs: inputs * features, width: features, frames, blocks };
            Stage::zeros(sizes, device)
        };
        Self {
            spynet: SpyNet::zeros(6, [32, 64, 32, 16], CHANNELS.into(), device),
            feat_extract: Extractor {
                first: conv([channels, features], 3),
                second: conv([features, features], 3),
                stage: stage(1, 1, 1),
            },
            backbone: (0..PROPAGATIONS.len()).map(|i| stage(2 + i, CLIP, blocks)).collect(),
            deform_align: PROPAGATIONS
                .map(|_| GuidedAttention::zeros(features, MIDDLE_WIDTH, device))
                .into(),
            reconstruction: stage(5, 1, 1),
            conv_before_upsampler: conv([features, MIDDLE_WIDTH], 1),
            upsampler: [4, 4, 1].map(|more| conv([MIDDLE_WIDTH, more * MIDDLE_WIDTH], 3)).into(),
            conv_last: conv([MIDDLE_WIDTH, channels], 3),
            channels,
        }
    }

    /// Returns the channels of images.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Returns the name of a parameter in the authors' files. Their convolutions have a third axis of one
    /// frame.
    pub fn authors_name(name: &str) -> String {
        let mut name = SpyNet::authors_name(name);
        for (number, (propagation, _)) in PROPAGATIONS.iter().enumerate() {
            for list in ["backbone", "deform_align"] {
                let from = format!("{list}.{number}.");
                if let Some(rest) = name.strip_prefix(&from) {
                    name = format!("{list}.{propagation}.{rest}");
                    break;
                }
            }
        }
        let pairs = [
            ("feat_extract.first.", "feat_extract.1."),
            ("feat_extract.second.", "feat_extract.3."),
            ("feat_extract.stage.", "feat_extract.6."),
            ("conv_before_upsampler.", "conv_before_upsampler.0."),
            ("upsampler.2.", "upsampler.10."),
            ("upsampler.1.", "upsampler.5."),
        ];
        let name = Stage::authors_name(&renamed(&name, &pairs));
        if name.starts_with("deform_align.") {
            let pairs = [
                ("proj_q.", "proj_q.1."),
                ("proj_k.", "proj_k.1."),
                ("proj_v.", "proj_v.1."),
                (".proj.", ".proj.1."),
                (".mlp.", ".mlp.1."),
            ];
            return renamed(&every_second(&name, "conv_offset."), &pairs);
        }
        name
    }

    /// Restores every frame of bursts.
    ///
    /// # Shapes
    /// - x, result: `[bursts * frames, channels, height, width]`; an even number of frames, sides multiples
    ///   of 4
    pub fn forward(&self, x: Tensor<4>, frames: usize) -> Tensor<4> {
        let flows = self.flows(&x, frames);
        let features = self.feat_extract.forward(x.clone());
        let clips = (0..frames / CLIP).map(|i| frames_from(&features, frames, CLIP * i, CLIP));
        let mut lists: Vec<Vec<Tensor<4>>> = vec![clips.collect()];
        // The flows that the first propagation in a direction finds serve the second.
        let mut found: [Vec<Pair>; 2] = [Vec::new(), Vec::new()];
        for (number, (_, backward)) in PROPAGATIONS.into_iter().enumerate() {
            let turn = |clips: &Vec<Tensor<4>>| {
                if backward { clips.iter().rev().map(turned).collect() } else { clips.clone() }
            };
            let earlier: Vec<_> = lists.iter().map(turn).collect();
            let direction = usize::from(!backward);
            let clips = self.propagate(number, &earlier, &flows[direction], &mut found[direction]);
            lists.push(turn(&clips));
        }
        let all = lists.into_iter().map(|clips| {
            let each = clips.iter().flat_map(|clip| [frame(clip, CLIP, 0), frame(clip, CLIP, 1)]);
            bursts_of(each.collect())
        });
        let features = Tensor::cat(all.collect(), 1);
        x + self.upsample(self.reconstruction.forward(features, frames))
    }

    /// Computes flows backward and forward: from every frame but the first, in the order of visiting, to the
    /// one before.
    fn flows(&self, x: &Tensor<4>, frames: usize) -> [Vec<Tensor<4>>; 2] {
        let small = quarter(x.clone());
        let pairs = frames - 1;
        let before = frames_from(&small, frames, 0, pairs);
        let after = frames_from(&small, frames, 1, pairs);
        let flow = |from: &Tensor<4>, to: &Tensor<4>| {
            let flow = self.spynet.forward(from.clone(), to.clone(), &[1]).remove(0);
            (0..pairs).map(|i| frame(&flow, pairs, i)).collect::<Vec<_>>()
        };
        let mut backward = flow(&before, &after);
        backward.reverse();
        [backward, flow(&after, &before)]
    }

    /// Propagates over clips in the order of visiting. `earlier` are the clips of all modules before.
    fn propagate(
        &self,
        number: usize,
        earlier: &[Vec<Tensor<4>>],
        flows: &[Tensor<4>],
        found: &mut Vec<Pair>,
    ) -> Vec<Tensor<4>> {
        let is_first = found.is_empty();
        let last = &earlier[earlier.len() - 1];
        let mut state = last[0].zeros_like();
        let mut results = Vec::with_capacity(last.len());
        for i in 0..last.len() {
            if i > 0 {
                let pair =
                    if is_first { pair_of(&flows[2 * i - 2..]) } else { found[i - 1].clone() };
                let warped = [
                    warp_zeros(state.clone(), pair[0].clone()),
                    warp_zeros(turned(&state), pair[1].clone()),
                ];
                let (q, k) = (last[i].clone(), last[i - 1].clone());
                let next;
                (state, next) = self.deform_align[number].forward(q, k, state, warped, pair);
                if is_first {
                    found.push(next);
                }
            }
            let mut inputs: Vec<_> = earlier.iter().map(|clips| clips[i].clone()).collect();
            inputs.push(state.clone());
            state = state + self.backbone[number].forward(Tensor::cat(inputs, 1), CLIP);
            results.push(state.clone());
        }
        results
    }

    fn upsample(&self, x: Tensor<4>) -> Tensor<4> {
        let mut x = leaky(self.conv_before_upsampler.linear(&[x]));
        for conv in &self.upsampler[..2] {
            x = leaky(pixel_shuffle(conv.linear(&[x]), 2));
        }
        self.conv_last.linear(&[self.upsampler[2].linear(&[x])])
    }
}

impl Extractor {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = leaky(self.first.stride2(&[x]));
        self.stage.forward(leaky(self.second.stride2(&[x])), 1)
    }
}

/// Returns the frames of a clip in reverse.
fn turned(clip: &Tensor<4>) -> Tensor<4> {
    let shape = clip.dims();
    by_burst(clip.clone(), CLIP).flip([1]).reshape(shape)
}

/// Chains the flows from every frame to the one before: from frames 2 and 3 to frames 0 and 1, and to 1 and
/// 0.
fn pair_of(flows: &[Tensor<4>]) -> Pair {
    let [n01, n12, n23] = [0, 1, 2].map(|k| flows[k].clone());
    let then = |first: &Tensor<4>, second: &Tensor<4>| {
        first.clone() + warp_zeros(second.clone(), first.clone())
    };
    let (n02, n13) = (then(&n12, &n01), then(&n23, &n12));
    let n03 = then(&n23, &n02);
    [bursts_of(vec![n02, n13]), bursts_of(vec![n12, n03])]
}
