//! Optical flow between neighbouring frames: SPyNet (Ranjan and Black 2017).

use crate::diffusion::{FlowConfig, FlowInputs};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::Layers;
use qudi_layers::resample::{avg_pool2, by_burst, mean_around, rescale_flow, shrink, upsample2};

/// Added to the contrast that images are divided by: what is flatter counts as flat.
const LEAST_CONTRAST: f32 = 0.05;

/// Scale of a last layer's output that corrects a flow, in cells. Adam moves all weights by the same amount,
/// and the sum of a whole layer's would jump.
const CORRECTION: f32 = 0.1;

/// Flows of every frame to its neighbours, `[bursts * frames, 2, height / scale, width / scale]`, x before y,
/// in cells of their grid; zero past the ends of a burst.
#[derive(Clone, Debug)]
pub struct Flows {
    /// `warp(x[i + 1], to_next[i])` resembles `x[i]`.
    pub to_next: Tensor<4>,
    /// `warp(x[i - 1], to_prev[i])` resembles `x[i]`.
    pub to_prev: Tensor<4>,
    /// Pixels of a side of a cell.
    pub scale: usize,
    /// What the coarser levels of the pyramid found, finest first, where it was kept.
    pub coarser: Vec<Flows>,
}

/// The flow network.
#[derive(Module, Debug)]
pub(crate) struct Flow {
    /// Finest first.
    levels: Vec<Layers>,
    /// Levels of the pyramid; the finest may have no network.
    pyramid: usize,
    scale: usize,
    #[module(skip)]
    inputs: FlowInputs,
}

impl FlowConfig {
    /// Creates the flow network, all weights zero.
    pub(crate) fn init(&self, device: &Device) -> Flow {
        let [a, b, c, d] = self.widths;
        let sizes = [[4, a], [a, b], [b, c], [c, d], [d, 2]];
        let level = |_| Layers::zeros(&sizes, 7, device);
        Flow {
            levels: (0..self.networks).map(level).collect(),
            pyramid: self.levels,
            scale: self.scale,
            inputs: self.inputs,
        }
    }
}

impl Flow {
    /// Estimates the flows between the pre-denoised frames `d`.
    ///
    /// # Shapes
    /// - d: `[bursts * frames, 1, height, width]`
    pub(crate) fn forward(&self, d: Tensor<4>, frames: usize) -> Flows {
        if frames < 2 {
            return self.still(&d);
        }
        let device = d.device();
        // Both directions of every pair of neighbours at once.
        let mut finer = both(shrink(d, self.scale), frames);
        let mut pyramid = Vec::with_capacity(self.pyramid);
        for _ in 1..self.pyramid {
            let coarser = (avg_pool2(finer.0.clone()), avg_pool2(finer.1.clone()));
            pyramid.push(std::mem::replace(&mut finer, coarser));
        }
        pyramid.push(finer);
        let [pairs, _, h, w] = pyramid[self.pyramid - 1].0.dims();
        let mut flow = Tensor::zeros([pairs, 2, h, w], &device);
        let mut found = Vec::with_capacity(self.pyramid);
        // Coarsest first.
        for (number, (frame, neighbour)) in pyramid.into_iter().enumerate().rev() {
            if number + 1 < self.pyramid {
                flow = upsample2(flow) * 2.0;
            }
            if let Some(at) = number.checked_sub(self.pyramid - self.levels.len()) {
                flow = self.corrected(&self.levels[at], frame, neighbour, flow);
            }
            found.push(Flows::of_pairs(flow.clone(), frames, self.scale << number));
        }
        let finest = found.pop().expect("a level");
        found.reverse();
        Flows { coarser: found, ..finest }
    }

    /// Returns flows of frames that do not move.
    pub(crate) fn still(&self, d: &Tensor<4>) -> Flows {
        let [images, _, height, width] = d.dims();
        let grid = [height / self.scale, width / self.scale];
        let none = Tensor::zeros([images, 2, grid[0], grid[1]], &d.device());
        let (to_next, coarser) = (none.clone(), Vec::new());
        Flows { to_next, to_prev: none, scale: self.scale, coarser }
    }

    /// Corrects a flow by the network of a level.
    fn corrected(
        &self,
        level: &Layers,
        frame: Tensor<4>,
        neighbour: Tensor<4>,
        flow: Tensor<4>,
    ) -> Tensor<4> {
        let warped = warp(neighbour, flow.clone());
        let [frame, warped] = match self.inputs {
            // Stretched to the flow's own range.
            FlowInputs::Images => [frame, warped].map(|image| (image - 0.5) * 4.0),
            FlowInputs::Contrast => {
                let detail = frame.clone() - mean_around(frame.clone(), 2);
                let variance = mean_around(detail.clone().powi_scalar(2), 4);
                let contrast = (variance + LEAST_CONTRAST * LEAST_CONTRAST).sqrt();
                [detail / contrast.clone(), (warped - frame) * 2.0 / contrast]
            }
        };
        flow.clone() + level.forward(vec![frame, warped, flow]) * CORRECTION
    }
}

impl Flows {
    /// Splits the flows of [pairs](both) of bursts of `frames` frames.
    fn of_pairs(flow: Tensor<4>, frames: usize, scale: usize) -> Self {
        let pairs = flow.dims()[0] / 2;
        let part = |first| by_burst(flow.clone().narrow(0, first, pairs), frames - 1);
        let pad = |flow: Tensor<5>, before: usize| {
            let [bursts, _, _, h, w] = flow.dims();
            let none = Tensor::zeros([bursts, 1, 2, h, w], &flow.device());
            let list = if before == 1 { vec![none, flow] } else { vec![flow, none] };
            Tensor::cat(list, 1).reshape([bursts * frames, 2, h, w])
        };
        let (to_next, to_prev) = (pad(part(0), 0), pad(part(pairs), 1));
        Self { to_next, to_prev, scale, coarser: Vec::new() }
    }

    /// Computes the mean absolute difference between warped neighbours and frames, `[1]`, on the grid of
    /// every level that was kept: the mean over levels.
    ///
    /// # Shapes
    /// - images, the true frames: `[bursts * frames, 1, height, width]`
    pub fn warping_error(&self, images: &Tensor<4>, frames: usize) -> Tensor<1> {
        let levels = self.coarser.iter();
        let errors = levels.map(|level| level.own_warping_error(images, frames));
        errors.fold(self.own_warping_error(images, frames), Tensor::add)
            / (self.coarser.len() + 1) as f32
    }

    fn own_warping_error(&self, images: &Tensor<4>, frames: usize) -> Tensor<1> {
        let images = shrink(images.clone(), self.scale);
        let one = |next: bool, flow: &Tensor<4>| {
            let warped = warp(shifted(images.clone(), frames, next), flow.clone());
            (warped - images.clone()).abs().mean()
        };
        (one(true, &self.to_next) + one(false, &self.to_prev)) * 0.5
    }

    /// Returns the same flows on a grid of another scale, without coarser levels.
    #[must_use]
    pub fn at(&self, scale: usize) -> Self {
        let to = |flow: &Tensor<4>| rescale_flow(flow.clone(), self.scale, scale);
        let (to_next, to_prev) = (to(&self.to_next), to(&self.to_prev));
        Self { to_next, to_prev, scale, coarser: Vec::new() }
    }
}

/// Returns the next frame of every frame, or the one before; at the ends the frame itself, where the flow is
/// zero.
pub(super) fn shifted(x: Tensor<4>, frames: usize, next: bool) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let x = by_burst(x, frames);
    let part = |first, count| x.clone().narrow(1, first, count);
    let parts = if next {
        vec![part(1, frames - 1), part(frames - 1, 1)]
    } else {
        vec![part(0, 1), part(0, frames - 1)]
    };
    Tensor::cat(parts, 1).reshape([images, c, h, w])
}

/// Returns frames and neighbours: first every frame but the last with the next one, then every frame but the
/// first with the one before.
fn both(x: Tensor<4>, frames: usize) -> (Tensor<4>, Tensor<4>) {
    let [images, c, h, w] = x.dims();
    let pairs = images / frames * (frames - 1);
    let part =
        |first| by_burst(x.clone(), frames).narrow(1, first, frames - 1).reshape([pairs, c, h, w]);
    let (early, late) = (part(0), part(1));
    let firsts = Tensor::cat(vec![early.clone(), late.clone()], 0);
    (firsts, Tensor::cat(vec![late, early], 0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    /// Two frames that differ by a checkerboard: on a coarser grid they are the same.
    #[test]
    fn warping_error_is_the_mean_over_levels() {
        let device = Device::flex();
        let value = |i: usize| {
            let (frame, sign) = (i / 64, if (i / 8 + i).is_multiple_of(2) { 1.0 } else { -1.0 });
            0.5 + 0.1 * frame as f32 * sign
        };
        let data = TensorData::new((0..128).map(value).collect::<Vec<_>>(), [2, 1, 8, 8]);
        let images = Tensor::from_data(data, &device);
        let still = |side: usize| {
            let flow = Tensor::zeros([2, 2, side, side], &device);
            Flows { to_next: flow.clone(), to_prev: flow, scale: 8 / side, coarser: Vec::new() }
        };
        let error = |flows: &Flows| flows.warping_error(&images, 2).into_scalar::<f32>();
        // Half of the frames have no neighbour on that side.
        assert!((error(&still(8)) - 0.05).abs() < 1e-6);
        assert!(error(&still(4)) < 1e-6);
        let levels = Flows { coarser: vec![still(4), still(2)], ..still(8) };
        assert!((error(&levels) - 0.05 / 3.0).abs() < 1e-6);
    }
}
