//! RVRT among the learned methods.

use super::{CLIP, MULTIPLE, Rvrt, Sizes};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses};
use crate::method::LearnedMethod;
use crate::parts::charbonnier;
use crate::restorer::{Window, copies};
use burn::tensor::{Device, Tensor};
use qudi_core::Result;
use qudi_layers::mirrored;

/// Standard deviation of the initial weights of attention.
const ATTENTION_DEVIATION: f32 = 0.02;

impl LearnedMethod for Rvrt {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/rvrt.toml");
    const MARK: &'static str = "reconstruction.main.1.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 170;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        Ok(Sizes {
            channels: shapes.side("conv_last.weight", 0)?,
            features: shapes.side("feat_extract.3.weight", 0)?,
            blocks: shapes.count("backbone.backward_1.main.5"),
        })
    }

    fn describe(s: Sizes) -> String {
        format!("{} features, {} blocks, {} channels", s.features, s.blocks, s.channels)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.channels, s.features, s.blocks]
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        let impossible = !s.features.is_multiple_of(12) || ![1, 3].contains(&s.channels);
        impossible
            .then_some("RVRT has features in multiples of 12, and images of one or three channels")
    }

    fn other_lengths(_: Sizes, frames: usize) -> Option<String> {
        let fewest = 2 * CLIP;
        let fits = frames >= fewest && frames.is_multiple_of(CLIP);
        (!fits).then(|| format!("a multiple of {CLIP}, {fewest} or more"))
    }

    fn file_name(name: &str) -> String {
        Self::authors_name(name)
    }

    fn initial_law(_: Sizes, name: &str, _: &[usize]) -> Option<Law> {
        let linear = ["qkv_self", "attn.proj", "mlp.fc1", "mlp.fc2", "linear"];
        let is_linear = linear.iter().any(|layer| name.contains(&format!("{layer}.")));
        if name.contains("conv_offset.10.") || (is_linear && !name.ends_with(".weight")) {
            return Some(Law::Same(0.0));
        }
        let attention = is_linear || name.ends_with("relative_position_bias_table");
        attention.then_some(Law::Random(ATTENTION_DEVIATION))
    }

    fn context(&self) -> [usize; 2] {
        [0, 0]
    }

    /// Restores all frames; the last one is mirrored if their number is odd.
    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.all();
        let count = frames.len().next_multiple_of(CLIP);
        let even: Vec<_> =
            (0..count as i64).map(|place| frames[mirrored(place, frames.len())].clone()).collect();
        Ok(window.requested_of(self.forward(copies(&even, self.channels()), count)))
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let [counts, truth] = bursts.copies(self.channels());
        vec![("image", charbonnier(self.forward(counts, bursts.frames), truth))].into()
    }
}
