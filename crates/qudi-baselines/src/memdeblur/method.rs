//! MemDeblur among the learned methods.

use super::{
    BACKWARD_STRIDE, BatchStatistics, MULTIPLE, MemDeblur, Mode, PUBLISHED, Sizes, losses,
};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses, ends_with_any, kaiming};
use crate::method::LearnedMethod;
use crate::restorer::{Window, copies};
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// Factor of the initial weights of residual blocks, relative to those that keep the size of signals.
const INITIAL_SCALE: f32 = 0.1;

impl LearnedMethod for MemDeblur {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/memdeblur.toml");
    const MARK: &'static str = "memory.key_proj.key_proj.weight";
    const MULTIPLE: usize = MULTIPLE;
    const BYTES: usize = 205;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        Ok(Sizes {
            channels: shapes.side("downsampling.0.weight", 0)?,
            features: shapes.side("fusion.weight", 0)?,
            forward_blocks: shapes.count("forward_resblocks.main.0"),
            backward_blocks: shapes.count("backward_resblocks.main.2"),
            memory_blocks: shapes.count("memory.key_encoder.forward_resblocks.main.2"),
            bottlenecks: shapes.count("memory.key_encoder.layer1"),
            ..PUBLISHED
        })
    }

    fn describe(s: Sizes) -> String {
        format!("{} features, {} blocks", s.features, s.forward_blocks)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        let blocks = [s.forward_blocks, s.backward_blocks, s.memory_blocks, s.bottlenecks];
        [&[s.channels, s.features], &blocks[..]].concat()
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        let impossible = !s.features.is_multiple_of(8) || s.bottlenecks == 0;
        impossible.then_some("MemDeblur has features in multiples of 8, and a bottleneck or more")
    }

    fn other_lengths(_: Sizes, frames: usize) -> Option<String> {
        let step = BACKWARD_STRIDE;
        (frames <= step || frames % step != 1).then(|| format!("a multiple of {step} and one more"))
    }

    fn file_name(name: &str) -> String {
        Self::authors_name(name)
    }

    fn initial_law(_: Sizes, name: &str, shape: &[usize]) -> Option<Law> {
        let layer =
            ends_with_any(name, &["conv1.weight", "conv2.weight", "conv1.bias", "conv2.bias"]);
        if !layer || !name.contains("resblocks.") {
            return None;
        }
        let is_weight = name.ends_with(".weight");
        Some(if is_weight { kaiming(INITIAL_SCALE, shape) } else { Law::Same(0.0) })
    }

    fn context(&self) -> [usize; 2] {
        [0, 0]
    }

    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.all();
        let [_, _, full] = self.forward(&copies(frames, self.channels()), frames.len(), Mode::Use);
        Ok(window.requested_of(full))
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let [counts, truth] = bursts.copies(self.channels());
        let batch = BatchStatistics::default();
        let outputs = self.forward(&counts, bursts.frames, Mode::Training(Some(&batch)));
        let [quarter, half, full] = losses(outputs, &truth);
        let terms = vec![("image", full), ("half", half), ("quarter", quarter)];
        NetworkLosses { terms, statistics: batch.into_moved() }
    }
}
