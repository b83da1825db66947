//! Temporal fusion: aligned neighbours on the fine levels, a bidirectional recurrence on a coarser one.

use super::features::Pyramid;
use super::flow::{Flows, shifted};
use crate::diffusion::{FeaturesConfig, FusionConfig};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::DenseBlock;
use qudi_layers::resample::{avg_pool2, by_burst};
use qudi_layers::{Bias, Conv2d};

/// The recurrent cell; its weights serve both directions.
#[derive(Module, Debug)]
struct Cell {
    join: Conv2d,
    block: DenseBlock,
    leave: Conv2d,
}

/// The temporal fusion.
#[derive(Module, Debug)]
pub(crate) struct Fusion {
    enter: Vec<Conv2d>,
    align: Vec<Conv2d>,
    cell: Cell,
    /// Scale of level 0.
    fold: usize,
}

impl FusionConfig {
    /// Creates the fusion of features of these widths and of `pre` features of the pre-denoiser, all weights
    /// zero.
    pub(crate) fn init(
        &self,
        features: &FeaturesConfig,
        pre: usize,
        fold: usize,
        device: &Device,
    ) -> Fusion {
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let enter = |k: usize| {
            let before = match k {
                0 => pre,
                k if k > self.level => self.widths[k - 1],
                _ => 0,
            };
            conv([features.low[k] + features.high[k] + before, self.widths[k]], 1)
        };
        let align = |k: usize| conv([3 * self.widths[k], self.widths[k]], 3);
        let width = self.widths[self.level];
        Fusion {
            enter: (0..3).map(enter).collect(),
            align: (0..self.level).map(align).collect(),
            cell: Cell {
                join: conv([2 * width, width], 1),
                block: DenseBlock::zeros(width, self.growth, device),
                leave: conv([3 * width, width], 1),
            },
            fold,
        }
    }
}

impl Fusion {
    /// Fuses the features of measurements, noisy image and pre-denoiser (level 0), on three levels. With
    /// `alone`, no frame sees another.
    pub(crate) fn forward(
        &self,
        low: Pyramid,
        high: Pyramid,
        pre: Tensor<4>,
        flows: &Flows,
        frames: usize,
        alone: bool,
    ) -> Pyramid {
        let level = self.align.len();
        let mut fused: Vec<Tensor<4>> = Vec::with_capacity(3);
        for (k, (low, high)) in low.into_iter().zip(high).enumerate() {
            let mut inputs = vec![low, high];
            if k == 0 {
                inputs.push(pre.clone());
            }
            if k > level {
                inputs.push(avg_pool2(fused[k - 1].clone()));
            }
            let x = self.enter[k].relu(&inputs);
            fused.push(if k > level {
                x
            } else {
                let flows = flows.at(self.fold << k);
                match (k < level, alone) {
                    (true, false) => self.aligned(k, x, &flows, frames),
                    (true, true) => self.align[k].relu(&[x.clone(), x.clone(), x]),
                    (false, false) => self.cell.forward(x, &flows, frames),
                    (false, true) => self.cell.alone(x),
                }
            });
        }
        fused.try_into().expect("three levels")
    }

    /// Joins every frame with its warped neighbours.
    fn aligned(&self, k: usize, x: Tensor<4>, flows: &Flows, frames: usize) -> Tensor<4> {
        // Past the ends the flow is zero and the neighbour the frame itself: warping changes nothing there.
        let next = warp(shifted(x.clone(), frames, true), flows.to_next.clone());
        let prev = warp(shifted(x.clone(), frames, false), flows.to_prev.clone());
        self.align[k].relu(&[x, next, prev])
    }
}

impl Cell {
    /// Computes the first frame of both sweeps, for every frame.
    fn alone(&self, x: Tensor<4>) -> Tensor<4> {
        let h = self.block.forward(self.join.relu(&[x.clone(), x.zeros_like()]));
        self.leave.relu(&[h.clone(), h, x])
    }

    fn forward(&self, x: Tensor<4>, flows: &Flows, frames: usize) -> Tensor<4> {
        let [images, c, h, w] = x.dims();
        let bursts = images / frames;
        let by_frame = |x: &Tensor<4>| by_burst(x.clone(), frames);
        let (inputs, to_next, to_prev) =
            (by_frame(&x), by_frame(&flows.to_next), by_frame(&flows.to_prev));
        let frame = |x: &Tensor<5>, i: usize| {
            let [bursts, _, c, h, w] = x.dims();
            x.clone().narrow(1, i, 1).reshape([bursts, c, h, w])
        };
        // Both sweeps run at once: frame i forward with frame N - 1 - i backward.
        let mut state: Option<Tensor<4>> = None;
        let (mut forward, mut backward) = (Vec::new(), Vec::new());
        for i in 0..frames {
            let j = frames - 1 - i;
            let input = Tensor::cat(vec![frame(&inputs, i), frame(&inputs, j)], 0);
            let warped = match state {
                None => input.zeros_like(),
                Some(state) => {
                    let flow = Tensor::cat(vec![frame(&to_prev, i), frame(&to_next, j)], 0);
                    warp(state, flow)
                }
            };
            let h = self.block.forward(self.join.relu(&[input, warped]));
            forward.push(h.clone().narrow(0, 0, bursts));
            backward.push(h.clone().narrow(0, bursts, bursts));
            state = Some(h);
        }
        backward.reverse();
        let joined = |list: Vec<Tensor<4>>| {
            Tensor::stack::<5>(list, 1).reshape([images, c, h, w]) // [B, N, ..] to [B * N, ..]
        };
        self.leave.relu(&[joined(forward), joined(backward), x])
    }
}
