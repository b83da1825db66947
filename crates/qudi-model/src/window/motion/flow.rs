//! Optical flow between neighbouring frames: soft block matching, corrected by networks from coarse to fine.

use super::matching::soft_match;
use crate::window::config::{FOLD, LEVELS, WindowConfig};
use crate::window::hourglass::{Pyramid, normalized};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::resample::{avg_pool2, by_burst, shrink, upsample2};
use qudi_layers::{Bias, Conv2d, ResidualStack};

/// Channels of the features that are compared.
const COMPARED: usize = 24;

/// Farthest matches at half, a quarter and an eighth of the resolution, in cells; none at half.
const RADIUS: [usize; LEVELS] = [0, 3, 4];

/// Scale of the differences of frames among the inputs.
const DIFFERENCE: f32 = 8.0;

/// Scale of displacements among the inputs.
const DISPLACEMENT: f32 = 0.25;

/// Planes among the inputs, without the compared features: difference, its size, frame, flow, and the flow of
/// related pairs.
const PLANES: usize = 3 + 2 + 6;

/// The network of one level.
#[derive(Module, Debug)]
pub(in crate::window) struct FlowLevel {
    compared: Conv2d,
    stack: ResidualStack,
    out: Conv2d,
}

/// The networks of all levels, finest first.
#[derive(Module, Debug)]
pub(in crate::window) struct Flow {
    levels: Vec<FlowLevel>,
}

/// Flow from every frame to its neighbours, on the grid of one level, in its cells.
#[derive(Clone, Debug)]
pub struct WindowFlow {
    /// First every frame but the last to the next one, then every frame but the first to the one before:
    /// `[2 * bursts * (frames - 1), 2, h, w]`.
    pub pairs: Tensor<4>,
    /// Pixels of a side of a cell.
    pub scale: usize,
}

impl WindowConfig {
    pub(in crate::window) fn init_flow(&self, device: &Device) -> Flow {
        let level = |level: usize| {
            let width = self.flow[level];
            FlowLevel {
                compared: Conv2d::zeros([self.widths[level], COMPARED], 1, Bias::Yes, device),
                stack: ResidualStack::zeros([2 * COMPARED + PLANES, width], 1, device),
                out: Conv2d::zeros([width, 2], 3, Bias::Yes, device),
            }
        };
        Flow { levels: (0..LEVELS).map(level).collect() }
    }
}

/// Returns frames and their neighbours in the order of [`WindowFlow::pairs`].
pub(in crate::window) fn pairs(x: Tensor<4>, frames: usize) -> (Tensor<4>, Tensor<4>) {
    let [images, c, h, w] = x.dims();
    let count = images / frames * (frames - 1);
    let part =
        |first| by_burst(x.clone(), frames).narrow(1, first, frames - 1).reshape([count, c, h, w]);
    let (early, late) = (part(0), part(1));
    let references = Tensor::cat(vec![early.clone(), late.clone()], 0);
    (references, Tensor::cat(vec![late, early], 0))
}

/// Returns how the flow of the pairs before and after, and the opposite of the flow back, differ from every
/// pair's own, `[pairs, 6, h, w]`: noise makes them differ where motion does not.
fn related(flow: &Tensor<4>, pairs_of_burst: usize) -> Tensor<4> {
    let [pairs, _, h, w] = flow.dims();
    let last = pairs_of_burst - 1;
    let whole = by_burst(flow.clone(), pairs_of_burst);
    let shifted = |parts: [(usize, usize); 2]| {
        let parts = parts.map(|(first, count)| whole.clone().narrow(1, first, count));
        Tensor::cat(parts.to_vec(), 1).reshape([pairs, 2, h, w]) - flow.clone()
    };
    let (before, after) = (shifted([(0, 1), (0, last)]), shifted([(1, last), (last, 1)]));
    let half = pairs / 2;
    let parts = [half, 0].map(|first| flow.clone().narrow(0, first, half));
    let back = (Tensor::cat(parts.to_vec(), 0) + flow.clone()) * -1.0;
    Tensor::cat(vec![before, after, back], 1)
}

impl Flow {
    /// Estimates the flow on all levels, finest first. No gradient reaches the frames.
    ///
    /// # Shapes
    /// - restored: pre-denoised frames, `[bursts * frames, 1, H, W]` in image units
    pub(in crate::window) fn forward(
        &self,
        restored: &Tensor<4>,
        features: &Pyramid,
        frames: usize,
    ) -> Vec<WindowFlow> {
        let mut images = vec![shrink(restored.clone().detach(), FOLD)];
        for level in 1..LEVELS {
            images.push(avg_pool2(images[level - 1].clone()));
        }
        let mut found: Vec<WindowFlow> = Vec::with_capacity(LEVELS);
        for level in (0..LEVELS).rev() {
            let image = images.pop().expect("an image a level");
            let start = found.last().map(|coarser| upsample2(coarser.pairs.clone()) * 2.0);
            let pairs = self.levels[level].forward(image, &features[level], start, level, frames);
            found.push(WindowFlow { pairs, scale: FOLD << level });
        }
        found.reverse();
        found
    }
}

impl FlowLevel {
    fn forward(
        &self,
        image: Tensor<4>,
        features: &Tensor<4>,
        start: Option<Tensor<4>>,
        level: usize,
        frames: usize,
    ) -> Tensor<4> {
        let (reference, neighbour) = pairs(image, frames);
        let compared = normalized(self.compared.linear(std::slice::from_ref(features)));
        let (compared, other) = pairs(compared, frames);
        let [count, _, h, w] = reference.dims();
        let start = start.unwrap_or_else(|| Tensor::zeros([count, 2, h, w], &reference.device()));
        let mut flow = start.clone();
        if RADIUS[level] > 0 {
            let near = warp(neighbour.clone(), start.detach());
            // Values of no gradient: outside autodiff, then constants of it.
            let found = soft_match(reference.clone(), near, RADIUS[level], frames - 1).detach();
            flow = flow + found;
        }
        let other = warp(other, flow.clone());
        let difference = (warp(neighbour, flow.clone()) - reference.clone()) * DIFFERENCE;
        let motion = flow.clone().detach() * DISPLACEMENT;
        let related = related(&motion, frames - 1);
        let signed = reference * 2.0 - 1.0;
        let size = difference.clone().abs();
        let inputs = [compared, other, difference, size, signed, motion, related];
        flow + self.out.linear(&[self.stack.forward(&inputs)])
    }
}

impl WindowFlow {
    /// Returns the same outside autodiff.
    pub(in crate::window) fn inner(&self) -> Self {
        Self { pairs: self.pairs.clone().inner(), ..*self }
    }

    /// Returns the same within autodiff, as a constant.
    pub(in crate::window) fn from_inner(flow: Self) -> Self {
        Self { pairs: Tensor::from_inner(flow.pairs), ..flow }
    }

    /// Returns the flow of every burst from frame `frame` to the next one, or to the one before:
    /// `[bursts, 2, h, w]`.
    pub(in crate::window) fn of_frame(&self, frame: usize, next: bool, frames: usize) -> Tensor<4> {
        let [all, _, h, w] = self.pairs.dims();
        let half = all / 2;
        let (first, place) = if next { (0, frame) } else { (half, frame - 1) };
        let part = by_burst(self.pairs.clone().narrow(0, first, half), frames - 1);
        let bursts = half / (frames - 1);
        part.narrow(1, place, 1).reshape([bursts, 2, h, w])
    }

    /// Computes how well true frames agree with their neighbours along the flow, `[1]`: the mean over pairs
    /// of the logarithm of the mean difference, so that pairs that move little count as much as others.
    ///
    /// # Shapes
    /// - truth: `[bursts * frames, 1, H, W]` in image units
    pub fn warping_error(&self, truth: &Tensor<4>, frames: usize) -> Tensor<1> {
        /// Smooths the root of squares.
        const SMOOTH: f32 = 1e-5;
        /// Difference below which nothing more is won.
        const FLOOR: f32 = 5e-3;
        let (reference, neighbour) = pairs(shrink(truth.clone(), self.scale), frames);
        let difference = warp(neighbour, self.pairs.clone()) - reference;
        let [count, _, h, w] = difference.dims();
        let size = (difference.powi_scalar(2) + SMOOTH).sqrt().reshape([count, h * w]);
        (size.mean_dim(1) + FLOOR).log().mean()
    }
}
