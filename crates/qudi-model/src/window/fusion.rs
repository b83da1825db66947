//! Temporal fusion: recurrent states that run through the window, backward first, then forward.

use super::config::{IMAGE, WindowConfig};
use super::hourglass::normalized;
use super::input::MIDDLE;
use super::merging::MERGED;
use super::motion::flow::WindowFlow;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::{StackParameters, frames, warp};
use qudi_layers::ResidualStack;

/// Scale of frames around the middle level, and of a frame's difference from its linear estimate.
const SCALE: f32 = 3.0;

/// Scale of the differences from aligned neighbours.
const DIFFERENCE: f32 = 8.0;

/// The recurrent cells.
#[derive(Module, Debug)]
pub(super) struct Fusion {
    backward: ResidualStack,
    forward: ResidualStack,
}

/// The frames of all bursts as the cells see them.
pub(super) struct Frames<'a> {
    /// The cleanest frames so far in image units, `[bursts * frames, 4, h, w]`.
    pub(super) known: Tensor<4>,
    /// Linear estimate in image units, likewise.
    pub(super) linear: &'a Tensor<4>,
    /// Normalized features of the pre-denoiser, `[bursts * frames, width, h, w]`.
    pub(super) features: &'a Tensor<4>,
    /// Planes of the merged frames, `[bursts * frames, 8, h, w]`.
    pub(super) merged: &'a Tensor<4>,
    /// Frames of a burst.
    pub(super) count: usize,
}

impl WindowConfig {
    pub(super) fn init_fusion(&self, device: &Device) -> Fusion {
        let inputs = self.widths[0] + self.state + 4 * IMAGE + MERGED;
        let cell = |inputs| ResidualStack::zeros([inputs, self.state], self.cell_blocks, device);
        Fusion { backward: cell(inputs), forward: cell(inputs + self.state) }
    }
}

impl Fusion {
    /// Fuses the frames of every burst to states from the frames before and from those after,
    /// `[bursts * frames, state, h, w]` each.
    pub(super) fn forward(
        &self,
        window: &Frames<'_>,
        flow: &WindowFlow,
        state: usize,
    ) -> [Tensor<4>; 2] {
        let count = window.count;
        let [images, _, h, w] = window.features.dims();
        let bursts = images / count;
        let images_of_frames = Tensor::cat(vec![window.known.clone(), window.linear.clone()], 1);
        let [images_of, features, merged] =
            [&images_of_frames, window.features, window.merged].map(|x| frames(x, count));
        let step = |cell: &StackParameters,
                    frame: usize,
                    last: Option<(usize, &Tensor<4>)>,
                    more: Option<&Tensor<4>>| {
            let own = images_of[frame].clone();
            let (hidden, difference) = match last {
                Some((neighbour, hidden)) => {
                    let along = flow.of_frame(frame, neighbour > frame, count);
                    let aligned = warp(images_of[neighbour].clone(), along.clone());
                    (warp(hidden.clone(), along), (aligned - own.clone()) * DIFFERENCE)
                }
                None => (Tensor::zeros([bursts, state, h, w], &own.device()), own.zeros_like()),
            };
            let known = own.clone().narrow(1, 0, IMAGE);
            let noise = (own.narrow(1, IMAGE, IMAGE) - known.clone()) * SCALE;
            let images = vec![(known - MIDDLE) * SCALE, noise, difference];
            let mut inputs = vec![features[frame].clone(), hidden, Tensor::cat(images, 1)];
            inputs.extend(more.cloned());
            inputs.push(merged[frame].clone());
            normalized(cell.apply(&inputs))
        };
        let [backward, forward] = [&self.backward, &self.forward].map(ResidualStack::parameters);
        let mut later: Vec<Tensor<4>> = Vec::with_capacity(count);
        for frame in (0..count).rev() {
            let hidden =
                step(&backward, frame, later.last().map(|hidden| (frame + 1, hidden)), None);
            later.push(hidden);
        }
        later.reverse();
        let mut earlier: Vec<Tensor<4>> = Vec::with_capacity(count);
        for (frame, later) in later.iter().enumerate() {
            let last = earlier.last().map(|hidden| (frame - 1, hidden));
            let hidden = step(&forward, frame, last, Some(later));
            earlier.push(hidden);
        }
        [earlier, later].map(of_all)
    }
}

/// Joins the images of every frame, `[bursts, c, h, w]` each, in the order `[bursts * frames, c, h, w]`.
fn of_all(frames: Vec<Tensor<4>>) -> Tensor<4> {
    let [bursts, channels, h, w] = frames[0].dims();
    let images = bursts * frames.len();
    Tensor::stack::<5>(frames, 1).reshape([images, channels, h, w])
}
