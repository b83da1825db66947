//! Temporal fusion: recurrent states that run through the window, backward first, then forward.

use super::config::WindowConfig;
use super::flow::WindowFlow;
use super::hourglass::normalized;
use super::input::MIDDLE;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::ResidualStack;
use qudi_layers::resample::by_burst;

/// Planes of the pre-denoised frames and of the linear estimate at half the resolution.
const IMAGES: usize = 4;

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
        let inputs = self.widths[0] + self.state + 4 * IMAGES;
        let cell = |inputs| ResidualStack::zeros([inputs, self.state], self.cell_blocks, device);
        Fusion { backward: cell(inputs), forward: cell(inputs + self.state) }
    }
}

impl Fusion {
    /// Computes the states of every frame, from the frames before and from those after it:
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
        let of_frame = |x: &Tensor<4>, frame: usize| {
            let channels = x.dims()[1];
            by_burst(x.clone(), count).narrow(1, frame, 1).reshape([bursts, channels, h, w])
        };
        let images_of_frames = Tensor::cat(vec![window.restored.clone(), window.linear.clone()], 1);
        let frames: Vec<Tensor<4>> =
            (0..count).map(|frame| of_frame(&images_of_frames, frame)).collect();
        let features: Vec<Tensor<4>> =
            (0..count).map(|frame| of_frame(window.features, frame)).collect();
        let step = |cell: &ResidualStack,
                    frame: usize,
                    last: Option<(usize, &Tensor<4>)>,
                    more: Option<&Tensor<4>>| {
            let own = frames[frame].clone();
            let (hidden, difference) = match last {
                Some((neighbour, hidden)) => {
                    // The flow learns from true frames: the gradient of what is warped here is mostly
                    // noise, and a hundred times as large.
                    let along = flow.of_frame(frame, neighbour > frame, count).detach();
                    let both = Tensor::cat(vec![hidden.clone(), frames[neighbour].clone()], 1);
                    let both = warp(both, along);
                    let aligned = both.clone().narrow(1, state, 2 * IMAGES);
                    (both.narrow(1, 0, state), (aligned - own.clone()) * DIFFERENCE)
                }
                None => (Tensor::zeros([bursts, state, h, w], &own.device()), own.zeros_like()),
            };
            let restored = own.clone().narrow(1, 0, IMAGES);
            let noise = (own.narrow(1, IMAGES, IMAGES) - restored.clone()) * SCALE;
            let mut inputs = vec![
                features[frame].clone(),
                hidden,
                (restored - MIDDLE) * SCALE,
                noise,
                difference,
            ];
            inputs.extend(more.cloned());
            normalized(cell.forward(&inputs))
        };
        let mut later: Vec<Tensor<4>> = Vec::with_capacity(count);
        for frame in (0..count).rev() {
            let last = later.last().map(|hidden| (frame + 1, hidden));
            let hidden = step(&self.backward, frame, last, None);
            later.push(hidden);
        }
        later.reverse();
        let mut earlier: Vec<Tensor<4>> = Vec::with_capacity(count);
        for (frame, later) in later.iter().enumerate() {
            let last = earlier.last().map(|hidden| (frame - 1, hidden));
            let hidden = step(&self.forward, frame, last, Some(later));
            earlier.push(hidden);
        }
        [earlier, later].map(|list| Tensor::stack::<5>(list, 1).reshape([images, state, h, w]))
    }
}
