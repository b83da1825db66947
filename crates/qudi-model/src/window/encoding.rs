//! Encoding of a window: what does not depend on the reverse step.

use super::Window;
use super::agreement::Paths;
use super::config::FOLD;
use super::flow::WindowFlow;
use super::fusion::{Frames, Fused};
use super::hourglass::normalized;
use super::input::{MIDDLE, Measurement};
use super::merging::Merged;
use super::refinement::{flow_between, refined};
use crate::diffusion::Conditioning;
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_layers::resample::{by_burst, pixel_unshuffle};

/// Scale of pre-denoised frames around the middle level among the inputs of the U-Net.
const SCALE: f32 = 3.0;

/// Scale of features and states among the inputs of the U-Net: they are many, and with steps of one size for
/// all (Muon) their noise would drown the few images.
const FEATURES: f32 = 0.15;

/// A window as U-Net and agreement see it in every step.
#[derive(Clone, Debug)]
pub struct EncodedWindow {
    /// Pre-denoised frames in image units, `[bursts * frames, 1, H, W]`.
    pub restored: Tensor<4>,
    /// Learnt flow on all levels, finest first. Fusion and agreement follow the refined one.
    pub flow: Vec<WindowFlow>,
    /// Linear estimates merged along the flow, in image units, `[bursts * frames, 1, H, W]`.
    pub merged: Tensor<4>,
    /// Clean frames that the pass before predicted, about in [-1, 1]: `[bursts * frames, 1, H, W]`.
    pub(super) estimate: Option<Tensor<4>>,
    /// Features of the frames and states from both sides, scaled: `[bursts * frames, channels, h, w]` each.
    pub(super) features: [Tensor<4>; 3],
    /// Pre-denoised frames, `[bursts * frames, 4, h, w]`.
    pub(super) image: Tensor<4>,
    /// Logarithm of the number of merged frames, `[bursts * frames, 4, h, w]`.
    pub(super) merged_frames: Tensor<4>,
    pub(super) paths: Paths,
    /// The sensor's numbers, `[bursts * frames, 11, 1, 1]`.
    pub(super) sensor: Tensor<4>,
    pub(super) error_sigma: Tensor<4>,
}

/// The frames of a window, each by itself, and the learnt flow between them: what every pass begins with.
struct SingleFrames {
    measurement: Measurement,
    /// Linear estimate in image units, `[bursts * frames, 1, H, W]`.
    linear: Tensor<4>,
    restored: Tensor<4>,
    features: Tensor<4>,
    /// Pre-denoised frames as the U-Net sees them, `[bursts * frames, 4, h, w]`.
    image: Tensor<4>,
    flow: Vec<WindowFlow>,
    /// Frames of a burst.
    count: usize,
}

impl SingleFrames {
    /// Returns the same outside autodiff.
    fn inner(&self) -> Self {
        Self {
            measurement: self.measurement.inner(),
            linear: self.linear.clone().inner(),
            restored: self.restored.clone().inner(),
            features: self.features.clone().inner(),
            image: self.image.clone().inner(),
            flow: self.flow.iter().map(WindowFlow::inner).collect(),
            count: self.count,
        }
    }

    /// Returns the frames as the cells see them, of which `known` are the cleanest so far.
    fn frames<'a>(&'a self, known: &'a Tensor<4>) -> Frames<'a> {
        Frames {
            whole: [known, &self.linear],
            restored: pixel_unshuffle(known.clone(), FOLD),
            linear: &self.measurement.linear,
            features: &self.features,
            count: self.count,
        }
    }
}

impl EncodedWindow {
    fn new(single: &SingleFrames, fused: Fused, paths: Paths, estimate: Option<Tensor<4>>) -> Self {
        let Fused { states: [earlier, later], merged } = fused;
        Self {
            merged_frames: merged.planes_of_frames(),
            merged: merged.mean,
            restored: single.restored.clone(),
            estimate: estimate.map(|image| image * 2.0 - 1.0),
            paths,
            flow: single.flow.clone(),
            features: [single.features.clone(), earlier, later].map(|x| x * FEATURES),
            image: single.image.clone(),
            sensor: single.measurement.sensor.clone(),
            error_sigma: single.measurement.error_sigma.clone(),
        }
    }

    /// Returns sigma of usual errors in [-1, 1], `[bursts * frames, 1, 1, 1]`.
    pub fn error_sigma(&self) -> &Tensor<4> {
        &self.error_sigma
    }

    /// Returns the memory of all tensors, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let single = [&self.restored, &self.merged, &self.merged_frames, &self.image];
        let single = single.into_iter().chain(&self.estimate).chain(&self.features);
        let flows = self.flow.iter().map(|flow| &flow.pairs);
        let all = single.chain(flows).chain(self.paths.tensors());
        all.map(|x| x.shape().num_elements() * size_of::<f32>()).sum()
    }

    /// Returns the same outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        let inner = |x: &Tensor<4>| x.clone().inner();
        Self {
            restored: inner(&self.restored),
            merged: inner(&self.merged),
            merged_frames: inner(&self.merged_frames),
            flow: self.flow.iter().map(WindowFlow::inner).collect(),
            estimate: self.estimate.as_ref().map(inner),
            paths: self.paths.inner(),
            features: self.features.each_ref().map(inner),
            image: inner(&self.image),
            sensor: inner(&self.sensor),
            error_sigma: inner(&self.error_sigma),
        }
    }
}

impl Window {
    /// Encodes a window. Every pass after the first one sees the clean frames that the pass before predicts:
    /// it finds the flow between them, fuses the captured frames with them, and corrects them. Gradients
    /// reach the last pass only.
    pub fn encode(&self, conditioning: &Conditioning, passes: usize) -> EncodedWindow {
        let single = self.single_frames(conditioning);
        let sigma = &single.measurement.error_sigma;
        let flow = refined(&single.restored, sigma, &single.flow[0], single.count);
        if passes <= 1 {
            return self.fused(&single, &flow, None);
        }
        if single.restored.is_autodiff() {
            let (flow, estimate) = self.valid().estimate(&single.inner(), flow.inner(), passes - 1);
            let estimate = Tensor::from_inner(estimate);
            return self.fused(&single, &WindowFlow::from_inner(flow), Some(estimate));
        }
        let (flow, estimate) = self.estimate(&single, flow, passes - 1);
        self.fused(&single, &flow, Some(estimate))
    }

    /// Encodes the first frame of bursts in which nothing moves: all frames are merged, and no neighbour is
    /// seen. Passes as for [`encode`](Self::encode).
    pub fn encode_still(&self, conditioning: &Conditioning, passes: usize) -> EncodedWindow {
        let Conditioning { counts, linear_estimate, sensor, frames } = conditioning;
        let frames = *frames;
        let [images, _, h, w] = linear_estimate.dims();
        let shape = [images / frames, 1, h, w];
        let first = |x: &Tensor<4>| by_burst(x.clone(), frames).narrow(1, 0, 1).reshape(shape);
        let mean = by_burst(linear_estimate.clone(), frames).mean_dim(1).reshape(shape);
        let merged = Merged { frames: mean.ones_like() * frames as f32, mean };
        let single = self.single_frames(&Conditioning {
            counts: first(counts),
            linear_estimate: first(linear_estimate),
            sensor: sensor.clone(),
            frames: 1,
        });
        let mut estimate = None;
        if passes > 1 {
            let within = single.restored.is_autodiff();
            let (network, single, merged) = if within {
                (self.valid(), &single.inner(), merged.inner())
            } else {
                (self.clone(), &single, merged.clone())
            };
            for _ in 1..passes {
                let encoded = network.fused_still(single, merged.clone(), estimate);
                estimate = Some(network.posterior_mean(&encoded));
            }
            estimate = estimate.map(|x| if within { Tensor::from_inner(x) } else { x });
        }
        self.fused_still(&single, merged, estimate)
    }

    fn single_frames(&self, conditioning: &Conditioning) -> SingleFrames {
        let measurement = Measurement::new(conditioning);
        let (restored, pyramid) = self.pre.forward(&measurement);
        let flow = match conditioning.frames {
            1 => Vec::new(),
            frames => self.flow.forward(&restored, &pyramid, frames),
        };
        SingleFrames {
            linear: conditioning.linear_estimate.clone(),
            flow,
            features: normalized(pyramid[0].clone()),
            image: (pixel_unshuffle(restored.clone(), FOLD) - MIDDLE) * SCALE,
            count: conditioning.frames,
            measurement,
            restored,
        }
    }

    /// Predicts the clean frames in image units from the measurement alone in so many passes, and finds the
    /// flow between them.
    fn estimate(
        &self,
        single: &SingleFrames,
        mut flow: WindowFlow,
        passes: usize,
    ) -> (WindowFlow, Tensor<4>) {
        let mut estimate: Option<Tensor<4>> = None;
        for _ in 0..passes {
            let image = self.posterior_mean(&self.fused(single, &flow, estimate));
            flow = flow_between(image.clone(), &flow, single.count);
            estimate = Some(image);
        }
        (flow, estimate.expect("a pass"))
    }

    /// Predicts the clean frames in image units from the measurement alone.
    fn posterior_mean(&self, encoded: &EncodedWindow) -> Tensor<4> {
        let nothing = encoded.restored.zeros_like();
        let bursts = nothing.dims()[0] / encoded.paths.frames();
        let state = DiffusionState {
            x_t: nothing.clone(),
            x0_prev: nothing,
            has_previous: vec![false; bursts],
            timesteps: vec![NUM_TIMESTEPS - 1; bursts],
        };
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        (self.predict(encoded, &state, &schedule).x0 + 1.0) * 0.5
    }

    /// Fuses the frames along the flow. `estimate` are the clean frames that the pass before predicted.
    fn fused(
        &self,
        single: &SingleFrames,
        flow: &WindowFlow,
        estimate: Option<Tensor<4>>,
    ) -> EncodedWindow {
        let known = estimate.as_ref().unwrap_or(&single.restored);
        let fused = self.fusion.forward(&single.frames(known), flow, self.state);
        let paths = Paths::new(flow, single.count);
        EncodedWindow::new(single, fused, paths, estimate)
    }

    fn fused_still(
        &self,
        single: &SingleFrames,
        merged: Merged,
        estimate: Option<Tensor<4>>,
    ) -> EncodedWindow {
        let known = estimate.as_ref().unwrap_or(&single.restored);
        let fused = self.fusion.still(&single.frames(known), merged, self.state);
        EncodedWindow::new(single, fused, Paths::none(), estimate)
    }
}
