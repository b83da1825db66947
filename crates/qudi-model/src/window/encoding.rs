//! Encoding of a window: what does not depend on the reverse step.

use super::Window;
use super::agreement::Paths;
use super::config::FOLD;
use super::flow::WindowFlow;
use super::fusion::{Frames, Fused};
use super::hourglass::normalized;
use super::input::{MIDDLE, Measurement};
use super::motion::{Finder, Motion};
use crate::diffusion::Conditioning;
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_core::Result;
use qudi_layers::resample::pixel_unshuffle;

/// Scale of pre-denoised frames around the middle level among the inputs of the U-Net.
const SCALE: f32 = 3.0;

/// A window as U-Net and agreement see it in every step.
#[derive(Clone, Debug)]
pub struct EncodedWindow {
    /// Pre-denoised frames in image units, `[bursts * frames, 1, H, W]`.
    pub restored: Tensor<4>,
    /// Learnt flow on all levels, finest first; none where matched motion takes its place and nothing learns.
    pub flow: Vec<WindowFlow>,
    /// Linear estimates merged along the flow, in image units, `[bursts * frames, 1, H, W]`.
    pub merged: Tensor<4>,
    /// Clean frames that the pass before predicted, about in [-1, 1]: `[bursts * frames, 1, H, W]`.
    pub(super) estimate: Option<Tensor<4>>,
    /// Features of the frames, states from both sides and pre-denoised frames,
    /// `[bursts * frames, channels, h, w]` each.
    pub(super) features: Vec<Tensor<4>>,
    /// Planes of the merged frames, `[bursts * frames, 8, h, w]`.
    pub(super) merged_planes: Tensor<4>,
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
}

impl EncodedWindow {
    /// Returns sigma of usual errors in [-1, 1], `[bursts * frames, 1, 1, 1]`.
    pub fn error_sigma(&self) -> &Tensor<4> {
        &self.error_sigma
    }

    /// Returns the memory of all tensors, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let single = [&self.restored, &self.merged, &self.merged_planes];
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
            merged_planes: inner(&self.merged_planes),
            flow: self.flow.iter().map(WindowFlow::inner).collect(),
            estimate: self.estimate.as_ref().map(inner),
            paths: self.paths.inner(),
            features: self.features.iter().map(inner).collect(),
            sensor: inner(&self.sensor),
            error_sigma: inner(&self.error_sigma),
        }
    }
}

impl Window {
    /// Encodes a window. Every pass after the first one sees the clean frames that the pass before predicts:
    /// it finds the motion between them, fuses the captured frames with them, and corrects them. Gradients
    /// reach the last pass only.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    pub fn encode(&self, conditioning: &Conditioning, passes: usize) -> Result<EncodedWindow> {
        let single = self.single_frames(conditioning);
        if !single.restored.is_autodiff() {
            let (motion, estimate) =
                self.estimate(&single, conditioning, passes.saturating_sub(1))?;
            return Ok(self.fused(&single, motion, estimate));
        }
        let (motion, estimate) =
            self.valid().estimate(&single.inner(), conditioning, passes.saturating_sub(1))?;
        Ok(self.fused(&single, Motion::from_inner(motion), estimate.map(Tensor::from_inner)))
    }

    fn single_frames(&self, conditioning: &Conditioning) -> SingleFrames {
        let measurement = Measurement::new(conditioning);
        let (restored, pyramid) = self.pre.forward(&measurement);
        // Matched patches take the place of the learnt flow, which still learns.
        let learnt = conditioning.motion.is_empty() || restored.is_autodiff();
        let flow = || self.flow.forward(&restored, &pyramid, conditioning.frames);
        SingleFrames {
            linear: conditioning.linear_estimate.clone(),
            flow: if learnt { flow() } else { Vec::new() },
            features: normalized(pyramid[0].clone()),
            image: (pixel_unshuffle(restored.clone(), FOLD) - MIDDLE) * SCALE,
            count: conditioning.frames,
            measurement,
            restored,
        }
    }

    /// Finds the motion, and predicts the clean frames in image units from the measurement alone in so many
    /// passes. Without passes it predicts none.
    fn estimate(
        &self,
        single: &SingleFrames,
        conditioning: &Conditioning,
        passes: usize,
    ) -> Result<(Motion, Option<Tensor<4>>)> {
        let finder = match single.flow.first() {
            Some(flow) if conditioning.motion.is_empty() => Finder::Learnt(flow),
            _ => Finder::Matched(&conditioning.motion),
        };
        let mut motion =
            finder.first(&single.restored, &single.measurement.error_sigma, single.count)?;
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        let bursts = single.restored.dims()[0] / single.count;
        let state = DiffusionState {
            x_t: single.restored.zeros_like(),
            x0_prev: single.restored.zeros_like(),
            has_previous: vec![false; bursts],
            timesteps: vec![NUM_TIMESTEPS - 1; bursts],
        };
        let mut estimate: Option<Tensor<4>> = None;
        for _ in 0..passes {
            let encoded = self.fused(single, motion.clone(), estimate);
            let image = (self.predict(&encoded, &state, &schedule).x0 + 1.0) * 0.5;
            motion = finder.next(image.clone(), &motion, single.count)?;
            estimate = Some(image);
        }
        Ok((motion, estimate))
    }

    /// Fuses the frames along the flow. `estimate` are the clean frames that the pass before predicted.
    fn fused(
        &self,
        single: &SingleFrames,
        Motion { flow, paths }: Motion,
        estimate: Option<Tensor<4>>,
    ) -> EncodedWindow {
        let SingleFrames { measurement, linear, restored, features, count, .. } = single;
        let known = estimate.as_ref().unwrap_or(restored);
        let window = Frames {
            whole: [known, linear],
            restored: &pixel_unshuffle(known.clone(), FOLD),
            linear: &measurement.linear,
            features,
            count: *count,
        };
        let Fused { states: [earlier, later], merged } =
            self.fusion.forward(&window, &flow, self.state);
        EncodedWindow {
            merged_planes: merged.planes(),
            merged: merged.mean,
            restored: restored.clone(),
            estimate: estimate.map(|image| image * 2.0 - 1.0),
            paths,
            flow: single.flow.clone(),
            features: vec![features.clone(), earlier, later, single.image.clone()],
            sensor: measurement.sensor.clone(),
            error_sigma: measurement.error_sigma.clone(),
        }
    }
}
