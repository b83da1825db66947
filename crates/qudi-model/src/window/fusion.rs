//! Temporal fusion: recurrent states that run through the window, backward first, then forward.

use super::config::{IMAGE, WindowConfig};
use super::flow::WindowFlow;
use super::hourglass::normalized;
use super::input::MIDDLE;
use super::merging::{Gate, MERGED, Merged};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::{StackParameters, frames, warp};
use qudi_layers::ResidualStack;
use qudi_layers::resample::upsample2;

/// Scale of frames around the middle level, and of a frame's difference from its linear estimate.
const SCALE: f32 = 3.0;

/// Scale of the differences from aligned neighbours.
const DIFFERENCE: f32 = 8.0;

/// The recurrent cells.
#[derive(Module, Debug)]
pub(super) struct Fusion {
    backward: ResidualStack,
    forward: ResidualStack,
    gate: Gate,
}

/// The frames of all bursts as the cells see them.
pub(super) struct Frames<'a> {
    /// Pre-denoised frames and linear estimate in image units at full resolution,
    /// `[bursts * frames, 1, H, W]` each.
    pub(super) whole: [&'a Tensor<4>; 2],
    /// Pre-denoised frames in image units, `[bursts * frames, 4, h, w]`.
    pub(super) restored: &'a Tensor<4>,
    /// Linear estimate in image units, likewise.
    pub(super) linear: &'a Tensor<4>,
    /// Normalized features of the pre-denoiser, `[bursts * frames, width, h, w]`.
    pub(super) features: &'a Tensor<4>,
    /// Frames of a burst.
    pub(super) count: usize,
}

impl WindowConfig {
    pub(super) fn init_fusion(&self, device: &Device) -> Fusion {
        let inputs = self.widths[0] + self.state + 4 * IMAGE + MERGED;
        let cell = |inputs| ResidualStack::zeros([inputs, self.state], self.cell_blocks, device);
        Fusion {
            backward: cell(inputs),
            forward: cell(inputs + self.state),
            gate: Gate::zeros(self.widths[0], device),
        }
    }
}

/// What the cells pass on from frame to frame.
#[derive(Clone, Debug)]
struct Passed {
    hidden: Tensor<4>,
    merged: Merged,
}

/// What a window is fused to, for every frame.
#[derive(Debug)]
pub(super) struct Fused {
    /// States from the frames before, and from those after: `[bursts * frames, state, h, w]` each.
    pub(super) states: [Tensor<4>; 2],
    /// Linear estimates merged along the flow.
    pub(super) merged: Merged,
}

impl Fusion {
    /// Fuses the frames of every burst.
    pub(super) fn forward(&self, window: &Frames<'_>, flow: &WindowFlow, state: usize) -> Fused {
        let count = window.count;
        let [images, _, h, w] = window.features.dims();
        let bursts = images / count;
        let whole_flow = WindowFlow { pairs: upsample2(flow.pairs.clone()) * 2.0, scale: 1 };
        let of_frames = |x: &Tensor<4>| frames(x, count);
        let images_of_frames = Tensor::cat(vec![window.restored.clone(), window.linear.clone()], 1);
        let (images_of, features) = (of_frames(&images_of_frames), of_frames(window.features));
        let [restored, linear] = window.whole.map(of_frames);
        let between = self.gate.parameters();
        let step = |cell: &StackParameters,
                    frame: usize,
                    last: Option<(usize, &Passed)>,
                    more: Option<&Tensor<4>>| {
            let own = images_of[frame].clone();
            let (hidden, difference, merged) = match last {
                Some((neighbour, passed)) => {
                    let next = neighbour > frame;
                    let along = flow.of_frame(frame, next, count);
                    let hidden = warp(passed.hidden.clone(), along.clone());
                    let aligned = warp(images_of[neighbour].clone(), along);
                    let merged = self.gate.merge(
                        &between,
                        &passed.merged,
                        linear[frame].clone(),
                        restored[frame].clone(),
                        features[frame].clone(),
                        whole_flow.of_frame(frame, next, count),
                    );
                    (hidden, (aligned - own.clone()) * DIFFERENCE, merged)
                }
                None => (
                    Tensor::zeros([bursts, state, h, w], &own.device()),
                    own.zeros_like(),
                    Merged::single(linear[frame].clone()),
                ),
            };
            let restored = own.clone().narrow(1, 0, IMAGE);
            let noise = (own.narrow(1, IMAGE, IMAGE) - restored.clone()) * SCALE;
            let images = vec![(restored - MIDDLE) * SCALE, noise, difference];
            let mut inputs = vec![features[frame].clone(), hidden, Tensor::cat(images, 1)];
            inputs.extend(more.cloned());
            inputs.push(merged.planes());
            Passed { hidden: normalized(cell.apply(&inputs)), merged }
        };
        let [backward, forward] = [&self.backward, &self.forward].map(ResidualStack::parameters);
        let mut later: Vec<Passed> = Vec::with_capacity(count);
        for frame in (0..count).rev() {
            let last = later.last().map(|passed| (frame + 1, passed));
            let passed = step(&backward, frame, last, None);
            later.push(passed);
        }
        later.reverse();
        let mut earlier: Vec<Passed> = Vec::with_capacity(count);
        for (frame, later) in later.iter().enumerate() {
            let last = earlier.last().map(|passed| (frame - 1, passed));
            let passed = step(&forward, frame, last, Some(&later.hidden));
            earlier.push(passed);
        }
        let sides = [&earlier, &later];
        let [before, after] = sides.map(|list| Merged {
            mean: of_all(list.iter().map(|passed| &passed.merged.mean)),
            frames: of_all(list.iter().map(|passed| &passed.merged.frames)),
        });
        Fused {
            states: sides.map(|list| of_all(list.iter().map(|passed| &passed.hidden))),
            merged: Merged::joined(&before, &after, window.whole[1].clone()),
        }
    }
}

/// Joins the images of every frame, `[bursts, c, h, w]` each, in the order `[bursts * frames, c, h, w]`.
fn of_all<'a>(frames: impl Iterator<Item = &'a Tensor<4>>) -> Tensor<4> {
    let frames: Vec<Tensor<4>> = frames.cloned().collect();
    let [bursts, channels, h, w] = frames[0].dims();
    let images = bursts * frames.len();
    Tensor::stack::<5>(frames, 1).reshape([images, channels, h, w])
}
