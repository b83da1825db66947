//! QUIVER among the learned methods.

use super::{MULTIPLE, Quiver, Sizes};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses, ends_with_any};
use crate::method::LearnedMethod;
use crate::restorer::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// The dense block that files hold five times, and their copies of it.
const BLOCK: &str = "predenoise.rdbs.0.";
const COPIES: std::ops::Range<usize> = 1..5;

impl LearnedMethod for Quiver {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/quiver.toml");
    const MARK: &'static str = "predenoise.sfe1.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 1150;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        let features = shapes.side("predenoise.sfe1.weight", 0)?;
        let frames = shapes.side("spatial_att.conv.weight", 0)? / (4 * features).max(1);
        let past = frames.saturating_sub(1).div_ceil(2);
        Ok(Sizes {
            features,
            blocks: 1 + shapes.count("forward_cell.F_R.1.RDBs"),
            past,
            future: frames.saturating_sub(1 + past),
        })
    }

    fn describe(s: Sizes) -> String {
        let frames = s.past + 1 + s.future;
        format!("{} features, {} blocks, {frames} frames", s.features, s.blocks)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.features, s.blocks, s.past, s.future]
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        if !s.features.is_multiple_of(16) || s.blocks < 2 {
            return Some("QUIVER has features in multiples of 16, and two blocks or more");
        }
        let one_sided = s.past == 0 || s.future == 0;
        one_sided.then_some("QUIVER sees frames before and after the one that it restores")
    }

    fn problem_in_recipe(s: Sizes) -> Option<&'static str> {
        if s.past != s.future && s.past != s.future + 1 {
            return Some(
                "QUIVER sees as many frames before the one that it restores as after it, or one more",
            );
        }
        Self::problem(s)
    }

    fn other_lengths(s: Sizes, frames: usize) -> Option<String> {
        let fewest = s.past + 1 + s.future;
        (frames < fewest).then(|| format!("{fewest} or more"))
    }

    fn file_name(name: &str) -> String {
        Self::authors_name(name)
    }

    fn repeated_names(file_name: &str) -> Vec<String> {
        let Some(rest) = file_name.strip_prefix(BLOCK) else { return Vec::new() };
        COPIES.map(|k| format!("predenoise.rdbs.{k}.{rest}")).collect()
    }

    fn initial_law(_: Sizes, name: &str, _: &[usize]) -> Option<Law> {
        let zero = ["pa_deform.bias", "conv_offset.6.weight", "conv_offset.6.bias"];
        ends_with_any(name, &zero).then_some(Law::Same(0.0))
    }

    fn context(&self) -> [usize; 2] {
        self.reach().into()
    }

    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.around(self.context());
        let count = frames.len();
        Ok(window.split(self.forward(Tensor::cat(frames, 0), count).full, 0))
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let restored = self.forward(bursts.counts.clone(), bursts.frames);
        let [full, half, quarter, pre] =
            Quiver::losses(self, restored, &bursts.truth, bursts.frames);
        vec![("image", full), ("half", half), ("quarter", quarter), ("pre", pre)].into()
    }
}
