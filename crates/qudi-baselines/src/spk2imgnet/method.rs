//! Spk2ImgNet among the learned methods.

use super::{
    BLOCK, BLOCKS, Block, FRAMES, MULTIPLE, RESTORED_FRAME, SCALE, Sizes, Spk2ImgNet, losses,
};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses, ends_with_any};
use crate::method::LearnedMethod;
use crate::restorer::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use std::collections::VecDeque;

impl LearnedMethod for Spk2ImgNet {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/spk2imgnet.toml");
    const MARK: &'static str = "extractor.conv0_0.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 650;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        Ok(Sizes {
            features: shapes.side("extractor.conv.weight", 0)?,
            stem: shapes.side("extractor.conv0_0.weight", 0)?,
            blocks: shapes.count("extractor.net"),
            groups: shapes.side("pcd_align.pcd_align.cas_dcnpack.conv_offset_mask.weight", 0)? / 27,
        })
    }

    fn describe(s: Sizes) -> String {
        format!("{} features, {} blocks, {FRAMES} frames", s.features, s.blocks)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.features, s.stem, s.blocks, s.groups]
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        let divides = s.groups > 0 && s.features.is_multiple_of(s.groups);
        (!divides).then_some("groups of Spk2ImgNet divide its features")
    }

    fn other_lengths(_: Sizes, frames: usize) -> Option<String> {
        (frames != FRAMES).then(|| FRAMES.to_string())
    }

    fn file_name(name: &str) -> String {
        Self::authors_name(name)
    }

    fn initial_law(_: Sizes, name: &str, _: &[usize]) -> Option<Law> {
        if ends_with_any(name, &["prelu0.weight", "prelu1.weight"]) {
            return Some(Law::Same(0.25));
        }
        let zero = name.contains(".conv_offset_mask.")
            || ends_with_any(name, &["dcnpack_1.bias", "dcnpack.bias"]);
        zero.then_some(Law::Same(0.0))
    }

    fn context(&self) -> [usize; 2] {
        [RESTORED_FRAME, FRAMES - 1 - RESTORED_FRAME]
    }

    /// Restores one frame of each window; every block of frames is computed once.
    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.around(self.context());
        let mut blocks: VecDeque<Block> = VecDeque::new();
        window.each(|first| {
            while first + blocks.len() < (first + FRAMES - 1).min(frames.len() - 1) {
                let start = first + blocks.len();
                blocks.push_back(self.block(Tensor::cat(frames[start..start + BLOCK].to_vec(), 1)));
            }
            let seen: [&Block; BLOCKS] = std::array::from_fn(|number| &blocks[number * BLOCK]);
            let image = self.image(seen) / SCALE;
            blocks.pop_front();
            image
        })
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let (image, estimates) = self.forward(&bursts.as_channels(&bursts.counts));
        let [image, estimates] = losses(image, estimates, bursts.as_channels(&bursts.truth));
        vec![("image", image), ("estimates", estimates)].into()
    }
}
