//! QUIVER: quanta video restoration (Chennuri et al., ECCV 2024).

pub(crate) mod alignment;
mod cell;
mod merge;
mod method;
mod predenoiser;
pub(crate) mod reconstructor;

use crate::parts::{
    SpyNet, bursts_of, dense_blocks_renamed, every_second, frame, frames_from, gradient_loss,
    one_by_one, renamed,
};
use alignment::{Alignment, Extractor, GatedFusion};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use cell::Cell;
use merge::Merge;
use predenoiser::PreDenoiser;
use qudi_layers::resample::avg_pool2;
use reconstructor::Reconstructor;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 4;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of features, a multiple of 16.
    pub features: usize,
    /// Dense blocks of the recurrent cell.
    pub blocks: usize,
    /// Frames before the one that is restored.
    pub past: usize,
    /// Frames after it.
    pub future: usize,
}

/// The sizes of the authors' tests.
pub const PUBLISHED: Sizes = Sizes { features: 16, blocks: 12, past: 5, future: 5 };

/// The network.
#[derive(Module, Debug)]
pub struct Quiver {
    predenoise: PreDenoiser,
    spynet: SpyNet,
    extractor: Extractor,
    preden_extractor: Extractor,
    alignfuse: Vec<GatedFusion>,
    forward_cell: Cell,
    spatial_att: Merge,
    recons3: Reconstructor,
    recons12: Reconstructor,
    pa_deform: Alignment,
    past: usize,
    future: usize,
    features: usize,
}

/// Results of the network.
///
/// # Shapes
/// - predenoised: `[bursts * frames, 1, height, width]`
/// - full, half, quarter: `[bursts * restored, 1, ..]`, where `past + future` frames fewer are restored
#[derive(Clone, Debug)]
pub struct Restored {
    /// All frames, each denoised by itself.
    pub predenoised: Tensor<4>,
    /// The result.
    pub full: Tensor<4>,
    /// The result at half the size.
    pub half: Tensor<4>,
    /// The result at a quarter of the size.
    pub quarter: Tensor<4>,
}

impl Quiver {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { features, blocks, past, future } = sizes;
        let extractor = || Extractor::zeros(features, device);
        let reconstructor = || Reconstructor::zeros(features, device);
        Self {
            predenoise: PreDenoiser::zeros(features, device),
            spynet: SpyNet::zeros(4, [32, 64, 32, 16], vec![[0.449, 0.226]], device),
            extractor: extractor(),
            preden_extractor: extractor(),
            alignfuse: (0..3).map(|_| GatedFusion::zeros(features, device)).collect(),
            forward_cell: Cell::zeros(features, blocks, device),
            spatial_att: Merge::zeros(past + 1 + future, 4 * features, device),
            recons3: reconstructor(),
            recons12: reconstructor(),
            pa_deform: Alignment::zeros(features, device),
            past,
            future,
            features,
        }
    }

    /// Returns the numbers of frames before and after the one that is restored.
    pub fn reach(&self) -> (usize, usize) {
        (self.past, self.future)
    }

    /// Returns the name of a parameter in the authors' files.
    pub fn authors_name(name: &str) -> String {
        let name = SpyNet::authors_name(name);
        if name.starts_with("spynet.") {
            return name;
        }
        let name = dense_blocks_renamed(&name);
        let name = renamed(
            &name,
            &[
                ("predenoise.rdb.", "predenoise.rdbs.0."),
                ("predenoise.gff0.", "predenoise.gff.0."),
                ("predenoise.gff1.", "predenoise.gff.1."),
                ("alignfuse.2", "alignfuse_3"),
                ("alignfuse.1", "alignfuse_2"),
                ("alignfuse.0", "alignfuse_1"),
            ],
        );
        let name = Reconstructor::authors_name(&Merge::authors_name(&Cell::authors_name(&name)));
        every_second(&name, "pa_deform.conv_offset.")
    }

    /// Restores the frames that have enough others before and after them.
    ///
    /// # Shapes
    /// - x: `[bursts * frames, 1, height, width]`, sides multiples of 4
    pub fn forward(&self, x: Tensor<4>, frames: usize) -> Restored {
        let [images, _, height, width] = x.dims();
        let bursts = images / frames;
        let predenoised = one_by_one(&x, |image| self.predenoise.forward(image));
        // From every frame but the first to the one before.
        let pairs = frames - 1;
        let later = frames_from(&predenoised, frames, 1, pairs);
        let earlier = frames_from(&predenoised, frames, 0, pairs);
        let flows = self.spynet.forward(later, earlier, &[1, 2, 4]);
        let aligned = |extractor: &Extractor, video: &Tensor<4>| {
            let features = extractor.forward(video.clone(), frames);
            let pairs = features.into_iter().zip(&flows);
            pairs.map(|(f, flow)| self.pa_deform.frames(f, flow, frames)).collect::<Vec<_>>()
        };
        let of_clean = aligned(&self.preden_extractor, &predenoised);
        let of_noisy = aligned(&self.extractor, &x);
        let both = of_clean.into_iter().zip(of_noisy).zip(&self.alignfuse);
        let fused: Vec<_> = both
            .map(|((clean, noisy), fuse)| fuse.forward(Tensor::cat(vec![clean, noisy], 1)))
            .collect();
        let size = [bursts, 2 * self.features, height / 4, width / 4];
        let mut state = Tensor::zeros(size, &x.device());
        let mut maps = Vec::with_capacity(frames);
        for t in 0..frames {
            let now = |x: &Tensor<4>| frame(x, frames, t);
            let found;
            (found, state) = self.forward_cell.forward(&now(&x), fused.iter().map(now), state);
            maps.push(found);
        }
        let (mut full, mut half, mut quarter) = (Vec::new(), Vec::new(), Vec::new());
        for i in self.past..frames - self.future {
            // The frame itself comes last.
            let others = (i - self.past..i).chain(i + 1..=i + self.future);
            let window: Vec<_> = others.chain([i]).map(|j| maps[j][2].clone()).collect();
            let h = self.spatial_att.forward(&window);
            let (nothing, dark) = (h.zeros_like(), h.clone().narrow(1, 0, 1).zeros_like());
            let (image, f, next) = self.recons3.forward(h, nothing, dark);
            quarter.push(image);
            let (image, f, next) = self.recons12.forward(maps[i][1].clone(), f, next);
            half.push(image);
            full.push(self.recons12.image(maps[i][0].clone(), f, next).0);
        }
        let [full, half, quarter] = [full, half, quarter].map(bursts_of);
        Restored { predenoised, full, half, quarter }
    }

    /// Computes the terms of the training's loss, `[1]` each, with their weights: of the result, at half and
    /// at a quarter of the size, and of the frames denoised by themselves.
    ///
    /// # Shapes
    /// - truth: `[bursts * frames, 1, height, width]`
    pub fn losses(&self, restored: Restored, truth: &Tensor<4>, frames: usize) -> [Tensor<1>; 4] {
        let Restored { predenoised, full, half, quarter } = restored;
        let count = frames - self.past - self.future;
        let target = frames_from(truth, frames, self.past, count);
        [
            gradient_loss(full, target.clone()) * 0.85,
            gradient_loss(half, avg_pool2(target.clone())) * 0.1,
            gradient_loss(quarter, fourth(target)) * 0.05,
            gradient_loss(predenoised, truth.clone()) * 0.2,
        ]
    }
}

/// Returns means of the middle 2 x 2 of 4 x 4 pixels: bilinear, without a filter before it.
fn fourth(x: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = x.dims();
    crate::parts::resize(x, [height / 4, width / 4], crate::parts::Corners::Edges)
}
