//! FloRNN among the learned methods.

use super::{FloRnn, PUBLISHED, Sizes, loss};
use crate::import::Shapes;
use crate::learning::{Bursts, Law, NetworkLosses, kaiming};
use crate::method::LearnedMethod;
use crate::parts::frame;
use crate::restorer::Window;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// Factor of the initial weights, relative to those that keep the size of signals.
const INITIAL_SCALE: f32 = 0.2;

impl LearnedMethod for FloRnn {
    type Sizes = Sizes;

    const RECIPE: &'static str = include_str!("../../recipes/flornn.toml");
    const MARK: &'static str = "forward_rnn.first_conv.weight";
    const MULTIPLE: usize = 1;
    const BYTES: usize = 176;

    fn init(sizes: Sizes, device: &Device) -> Self {
        Self::zeros(sizes, device)
    }

    fn sizes(shapes: &Shapes<'_>) -> Result<Sizes> {
        Ok(Sizes {
            channels: shapes.side("d.convs.2.weight", 0)?,
            features: shapes.side("forward_rnn.first_conv.weight", 0)?,
            blocks: shapes.count("forward_rnn.resblocks"),
            flow: shapes.has_prefix("pwcnet."),
            ..PUBLISHED
        })
    }

    fn describe(s: Sizes) -> String {
        let flow = if s.flow { "" } else { ", no flow" };
        format!("{} features, {} blocks{flow}", s.features, s.blocks)
    }

    fn numbers(s: Sizes) -> Vec<usize> {
        vec![s.channels, s.features, s.blocks]
    }

    fn features(s: Sizes) -> usize {
        s.features
    }

    fn problem(s: Sizes) -> Option<&'static str> {
        (s.channels != 3).then_some("FloRNN has images of three channels")
    }

    fn other_lengths(s: Sizes, frames: usize) -> Option<String> {
        let fewest = s.ahead + 2;
        (frames < fewest).then(|| format!("{fewest} or more"))
    }

    fn file_name(name: &str) -> String {
        Self::authors_name(name)
    }

    fn initial_law(_: Sizes, name: &str, shape: &[usize]) -> Option<Law> {
        name.ends_with(".weight").then(|| kaiming(INITIAL_SCALE, shape))
    }

    fn context(&self) -> [usize; 2] {
        [1, self.window() - 2]
    }

    /// Restores the second frame of each window; the flow from each frame to the next is computed once.
    fn restore(&self, window: Window<'_>) -> Result<Vec<Tensor<4>>> {
        let frames = window.around(self.context());
        let copies = |frame: &Tensor<4>| frame.clone().repeat(&[1, self.channels(), 1, 1]);
        let frames: Vec<_> = frames.iter().map(copies).collect();
        let mut flows = Vec::new();
        window.each(|first| {
            let seen = &frames[first..first + self.window()];
            flows.extend(self.flows(&seen[flows.len()..]));
            let image = self.forward(seen, &flows).mean_dim(1);
            flows.drain(..flows.len().min(1));
            image
        })
    }

    fn losses(&self, _: &[&Self], bursts: &Bursts, _: u64) -> NetworkLosses {
        let [counts, truth] = bursts.copies(self.channels());
        let window: Vec<_> = (0..self.window()).map(|t| frame(&counts, bursts.frames, t)).collect();
        let image = self.forward(&window, &self.flows(&window));
        vec![("image", loss(image, frame(&truth, bursts.frames, 1)))].into()
    }
}
