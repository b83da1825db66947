//! Encoding of a window: what does not depend on the reverse step.

use super::Window;
use super::config::FOLD;
use super::fusion::Frames;
use super::hourglass::normalized;
use super::input::{MIDDLE, Measurement};
use super::merging::{Merged, averaged};
use super::motion::flow::WindowFlow;
use super::motion::paths::Paths;
use super::motion::refinement::pre_denoised_sigma;
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
    /// Learnt flow on all levels, finest first; none where matched motion takes its place.
    pub flow: Vec<WindowFlow>,
    /// The cleanest frames before the U-Net in image units, `[bursts * frames, 1, H, W]`: pre-denoised and
    /// averaged along the motion, or predicted by the pass before.
    pub(super) known: Tensor<4>,
    /// Counts merged along the motion, as images.
    pub(super) merged: Merged,
    /// Variance of the linear estimate's noise in image units, `[bursts * frames, 1, 1, 1]`.
    pub(super) noise_variance: Tensor<4>,
    /// Features of the frames, states from both sides and pre-denoised frames,
    /// `[bursts * frames, channels, h, w]` each.
    pub(super) features: Vec<Tensor<4>>,
    pub(super) paths: Paths,
    /// The sensor's numbers, `[bursts * frames, 11, 1, 1]`.
    pub(super) sensor: Tensor<4>,
    pub(super) error_sigma: Tensor<4>,
}

/// The frames of a window, each by itself, and the learnt flow between them: what every pass begins with.
struct SingleFrames {
    conditioning: Conditioning,
    measurement: Measurement,
    restored: Tensor<4>,
    features: Tensor<4>,
    /// Pre-denoised frames as the U-Net sees them, `[bursts * frames, 4, h, w]`.
    image: Tensor<4>,
    flow: Vec<WindowFlow>,
}

impl SingleFrames {
    /// Returns the same outside autodiff.
    fn inner(&self) -> Self {
        Self {
            conditioning: self.conditioning.inner(),
            measurement: self.measurement.inner(),
            restored: self.restored.clone().inner(),
            features: self.features.clone().inner(),
            image: self.image.clone().inner(),
            flow: self.flow.iter().map(WindowFlow::inner).collect(),
        }
    }
}

/// What a pass begins with.
#[derive(Clone, Debug)]
struct Basis {
    motion: Motion,
    /// The cleanest frames so far in image units, `[bursts * frames, 1, H, W]`.
    known: Tensor<4>,
    /// Counts merged along the motion.
    merged: Merged,
}

impl Basis {
    fn new(single: &SingleFrames, motion: Motion, known: Tensor<4>) -> Self {
        let sigma = single.measurement.error_sigma.clone() * 0.5;
        let Conditioning { counts, response, .. } = &single.conditioning;
        let merged = Merged::along(&motion.paths, counts, response, &known, &sigma);
        Self { motion, known, merged }
    }

    /// Returns the same inside autodiff, without gradient.
    fn from_inner(basis: Self) -> Self {
        Self {
            motion: Motion::from_inner(basis.motion),
            known: Tensor::from_inner(basis.known),
            merged: Merged::from_inner(basis.merged),
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
        let single = [&self.restored, &self.known, &self.merged.mean, &self.merged.frames];
        let single = single.into_iter().chain(&self.features);
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
            known: inner(&self.known),
            merged: self.merged.inner(),
            noise_variance: inner(&self.noise_variance),
            flow: self.flow.iter().map(WindowFlow::inner).collect(),
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
        let earlier = passes.saturating_sub(1);
        if !single.restored.is_autodiff() {
            let basis = self.basis(&single, earlier)?;
            return Ok(self.fused(&single, basis));
        }
        let basis = self.valid().basis(&single.inner(), earlier)?;
        Ok(self.fused(&single, Basis::from_inner(basis)))
    }

    fn single_frames(&self, conditioning: &Conditioning) -> SingleFrames {
        let measurement = Measurement::new(conditioning);
        let (restored, pyramid) = self.pre.forward(&measurement);
        // Matched patches take the place of the learnt flow.
        let flow = if conditioning.motion.is_empty() {
            self.flow.forward(&restored, &pyramid, conditioning.frames)
        } else {
            Vec::new()
        };
        SingleFrames {
            conditioning: conditioning.clone(),
            flow,
            features: normalized(pyramid[0].clone()),
            image: (pixel_unshuffle(restored.clone(), FOLD) - MIDDLE) * SCALE,
            measurement,
            restored,
        }
    }

    /// Finds the motion, and the cleanest frames along it in so many passes.
    fn basis(&self, single: &SingleFrames, passes: usize) -> Result<Basis> {
        let SingleFrames { conditioning, restored, .. } = single;
        let frames = conditioning.frames;
        let finder = match single.flow.first() {
            Some(flow) => Finder::Learnt(flow),
            None => Finder::Matched(&conditioning.motion),
        };
        let sigma = &single.measurement.error_sigma;
        let motion = finder.first(restored, sigma, frames)?;
        let known = averaged(restored, &pre_denoised_sigma(sigma), &motion.paths);
        let mut basis = Basis::new(single, motion, known);
        let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
        let bursts = restored.dims()[0] / frames;
        let state = DiffusionState {
            x_t: restored.zeros_like(),
            x0_prev: restored.zeros_like(),
            has_previous: vec![false; bursts],
            timesteps: vec![NUM_TIMESTEPS - 1; bursts],
        };
        for _ in 0..passes {
            let encoded = self.fused(single, basis.clone());
            let image = (self.predict(&encoded, &state, &schedule).x0 + 1.0) * 0.5;
            let motion = finder.next(image.clone(), &basis.motion, frames)?;
            basis = Basis::new(single, motion, image);
        }
        Ok(basis)
    }

    /// Fuses the frames along the motion.
    fn fused(&self, single: &SingleFrames, basis: Basis) -> EncodedWindow {
        let SingleFrames { measurement, restored, features, .. } = single;
        let Basis { motion: Motion { flow, paths }, known, merged } = basis;
        let window = Frames {
            known: pixel_unshuffle(known.clone(), FOLD),
            linear: &measurement.linear,
            features,
            merged: &merged.planes(),
            count: single.conditioning.frames,
        };
        let [earlier, later] = self.fusion.forward(&window, &flow, self.state);
        EncodedWindow {
            known,
            merged,
            noise_variance: measurement.noise_variance.clone(),
            restored: restored.clone(),
            paths,
            flow: single.flow.clone(),
            features: vec![features.clone(), earlier, later, single.image.clone()],
            sensor: measurement.sensor.clone(),
            error_sigma: measurement.error_sigma.clone(),
        }
    }
}
