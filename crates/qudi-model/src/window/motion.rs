//! The motion that a window is fused along: patches matched in the counts and on better frames, or the learnt
//! flow, refined.

pub(super) mod flow;
mod matching;
pub(super) mod paths;
pub(super) mod refinement;

use self::flow::WindowFlow;
use self::paths::Paths;
use self::refinement::{flow_between, pre_denoised_sigma, refined};
use super::config::FOLD;
use super::merging::{FARTHEST_FRAME, averaged};
use burn::tensor::{Device, Tensor, TensorData};
use qudi_burst::{BurstMotion, CellMotion, FoundMotion};
use qudi_core::{Frame, Result};
use qudi_layers::tensor::read;
use rayon::prelude::*;
use std::sync::Arc;

/// Flow from every frame to the next ones and to those before, on the grid of half the resolution.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    /// To the nearest frames.
    pub(super) flow: WindowFlow,
    /// Also to farther ones.
    pub(super) paths: Paths,
}

/// What finds the motion.
#[derive(Clone, Copy, Debug)]
pub(super) enum Finder<'a> {
    /// The learnt flow, refined by TV-L1.
    Learnt(&'a WindowFlow),
    /// Matching of patches, one finder for every burst.
    Matched(&'a [Arc<BurstMotion>]),
}

impl Motion {
    fn along(flow: WindowFlow, frames: usize) -> Self {
        Self { paths: Paths::new(&flow, frames), flow }
    }

    /// Returns the same inside autodiff, without gradient.
    pub(super) fn from_inner(motion: Self) -> Self {
        let Self { flow, paths } = motion;
        Self { flow: WindowFlow::from_inner(flow), paths: Paths::from_inner(paths) }
    }
}

impl Finder<'_> {
    /// Finds the motion between pre-denoised frames. No gradient passes.
    ///
    /// # Shapes
    /// - restored: `[bursts * frames, 1, H, W]` in image units
    /// - sigma: of usual errors in [-1, 1], `[bursts * frames, 1, 1, 1]`
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    pub(super) fn first(
        self,
        restored: &Tensor<4>,
        sigma: &Tensor<4>,
        frames: usize,
    ) -> Result<Motion> {
        let bursts = match self {
            Self::Learnt(flow) => {
                return Ok(Motion::along(refined(restored, sigma, flow, frames), frames));
            }
            Self::Matched(bursts) => bursts,
        };
        let device = restored.device();
        let found: Vec<_> =
            bursts.par_iter().map(|burst| burst.on_counts(FARTHEST_FRAME)).collect();
        let Motion { paths, .. } = motion(&found, frames, FARTHEST_FRAME, &device);
        let better = averaged(restored, &pre_denoised_sigma(sigma), &paths);
        on_frames(bursts, &better, frames)
    }

    /// Finds the motion between predicted frames, in image units; `before` is the motion so far.
    ///
    /// # Errors
    /// As [`Self::first`].
    pub(super) fn next(self, images: Tensor<4>, before: &Motion, frames: usize) -> Result<Motion> {
        match self {
            Self::Learnt(_) => {
                Ok(Motion::along(flow_between(images, &before.flow, frames), frames))
            }
            Self::Matched(bursts) => on_frames(bursts, &images, frames),
        }
    }
}

fn on_frames(bursts: &[Arc<BurstMotion>], images: &Tensor<4>, frames: usize) -> Result<Motion> {
    let values = read(images.clone())?;
    let per_burst = values.len() / bursts.len();
    let found: Vec<_> = bursts
        .par_iter()
        .zip(values.par_chunks(per_burst))
        .map(|(burst, values)| of_burst(burst, values))
        .collect();
    Ok(motion(&found, frames, frames, &images.device()))
}

/// Finds the motion on the better frames of one burst.
fn of_burst<'a>(burst: &'a BurstMotion, values: &[f32]) -> FoundMotion<'a> {
    let size = burst.size();
    let frames = values.chunks_exact(size.pixels());
    let frames: Vec<_> = frames.map(|data| Frame { size, data: data.to_vec() }).collect();
    burst.on_frames(&frames)
}

/// Samples the motion of patches at every cell, to frames up to `most` frames away.
fn motion(bursts: &[FoundMotion<'_>], frames: usize, most: usize, device: &Device) -> Motion {
    let bursts: Vec<_> = bursts.iter().map(|found| found.on_cells(FOLD)).collect();
    let of_distance = |distance: usize| {
        [true, false].map(|later| {
            let of_burst = |cells: &CellMotion<'_>| -> Vec<[Frame; 2]> {
                let pairs = (0..frames - distance).into_par_iter();
                let flow = |early: usize| {
                    let late = early + distance;
                    let [from, to] = if later { [early, late] } else { [late, early] };
                    cells.flow(from, to)
                };
                pairs.map(flow).collect()
            };
            let fields: Vec<[Frame; 2]> = bursts.iter().flat_map(of_burst).collect();
            let size = fields[0][0].size;
            let shape = [fields.len(), 2, size.height, size.width];
            let values = fields.into_iter().flatten().flat_map(|frame| frame.data).collect();
            Tensor::from_data(TensorData::new::<f32, _>(values, shape), device) / FOLD as f32
        })
    };
    let flows: Vec<_> = (1..frames.min(most + 1)).map(of_distance).collect();
    let pairs = Tensor::cat(flows[0].to_vec(), 0);
    Motion { flow: WindowFlow { pairs, scale: FOLD }, paths: Paths::of(flows, frames) }
}
