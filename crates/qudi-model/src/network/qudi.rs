//! The whole network: pre-denoiser, features, flow, fusion, U-Net.

use super::features::{HighFeatures, LowFeatures};
use super::flow::{Flow, Flows};
use super::fused::Fused;
use super::fusion::Fusion;
use super::layers::CORRECTION;
use super::normalized_input::NormalizedInput;
use super::parameters::initial_values;
use super::predenoiser::PreDenoiser;
use super::uncertainty::UncertaintyHead;
use super::unet::UNet;
use crate::conditioning::{AlignedTensors, Conditioning};
use crate::config::{NetworkConfig, NoisyFeatures, Part, UNetPrediction};
use crate::diffusion::precondition::Preconditioned;
use crate::diffusion::state::{DiffusionState, per_image};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::init_parameters;

/// The simulated measurement of the previous estimate.
///
/// # Shapes
/// - y, u: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Simulated {
    /// Counts over full scale.
    pub y: Tensor<4>,
    /// Their linear estimate in image units.
    pub u: Tensor<4>,
    /// Whether each burst has one; both tensors are zero where not.
    pub exists: Vec<bool>,
}

impl Simulated {
    /// The measurement of image `number` alone, of bursts of `frames` frames.
    #[must_use]
    pub fn image(&self, number: usize, frames: usize) -> Self {
        let one = |images: &Tensor<4>| images.clone().narrow(0, number, 1);
        Self { y: one(&self.y), u: one(&self.u), exists: vec![self.exists[number / frames]] }
    }

    /// The same measurement outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        let inner = |images: &Tensor<4>| images.clone().inner();
        Self { y: inner(&self.y), u: inner(&self.u), exists: self.exists.clone() }
    }
}

/// A burst's conditioning as the network encodes it, the same in every reverse step.
#[derive(Clone, Debug)]
pub struct Encoded {
    pre: EncodedPre,
    low: Tensor<4>,
    sensor: Tensor<2>,
    u: Tensor<4>,
    input: NormalizedInput,
    /// Variance of the noise of `u` at the mean light, `[images, 1, 1, 1]`.
    variance: Tensor<4>,
    frames: usize,
}

/// What every step begins with.
#[derive(Clone, Debug)]
enum EncodedPre {
    /// What the pre-denoiser makes of inputs that no step changes.
    Inputs(Box<Tensor<4>>),
    /// The pre-denoised frames and their features, where simulated measurements do not change them.
    Frames(Box<(Tensor<4>, Tensor<4>)>),
}

/// The network's prediction.
///
/// # Shapes
/// - x0, unit, d: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Prediction {
    /// The clean image, about in [-1, 1].
    pub x0: Tensor<4>,
    /// The unit of a correction of the pre-denoised frames: sigma of what is unknown of them if their errors are
    /// white, or of their errors themselves ([`UNetPrediction::Correction`]).
    pub unit: Tensor<4>,
    /// The pre-denoised frames, in image units.
    pub d: Tensor<4>,
    /// The flows that were used.
    pub flows: Flows,
}

/// The network of Quanta Diffusion.
#[derive(Module, Debug)]
pub struct Qudi {
    /// Pre-denoisers of the refinement stages: their frames are what the window is aligned on. They learn no
    /// more.
    stages: Vec<PreDenoiser>,
    pre: PreDenoiser,
    uncertainty: Option<UncertaintyHead>,
    low: LowFeatures,
    high: HighFeatures,
    flow: Flow,
    fusion: Fusion,
    unet: UNet,
    #[module(skip)]
    noisy: NoisyFeatures,
    #[module(skip)]
    predicts: UNetPrediction,
}

impl NetworkConfig {
    /// The network with initial weights of `seed`, the same on every device. The sizes must be
    /// [checked](Self::checked).
    pub fn init(&self, seed: u64, device: &Device) -> Qudi {
        let initial = |name: &str, shape: &[usize]| initial_values(seed, name, shape);
        init_parameters(self.uninitialized(device), initial)
    }

    /// The network without weights: it takes no memory yet.
    pub fn uninitialized(&self, device: &Device) -> Qudi {
        let stage = |_| self.pre.stage().init(self.reference, self.fold, device);
        Qudi {
            stages: (1..self.pre.stages).map(stage).collect(),
            pre: self.pre.init(self.reference, self.fold, device),
            uncertainty: self.pre.init_uncertainty(self.fold, device),
            low: self.features.init_low(self.fold, device),
            high: self.features.init_high(self.fold, device),
            flow: self.flow.init(self.ablates(Part::Flow), device),
            fusion: self.fusion.init(
                &self.features,
                self.pre.width,
                self.fold,
                self.ablates(Part::Fusion),
                device,
            ),
            unet: self.unet.init(&self.fusion, self.fold, device),
            noisy: self.features.noisy,
            predicts: self.unet.predicts,
        }
    }
}

impl Qudi {
    /// Encodes what does not depend on the step.
    pub fn encode(&self, conditioning: &Conditioning) -> Encoded {
        let input = NormalizedInput::new(conditioning);
        let pre = EncodedPre::Inputs(Box::new(self.pre.encode(&input)));
        self.encode_with(conditioning, input, pre)
    }

    /// [`Self::encode`] with pre-denoised frames and their features, in place of those that the network would compute.
    pub fn encode_predenoised(
        &self,
        conditioning: &Conditioning,
        frames: (Tensor<4>, Tensor<4>),
    ) -> Encoded {
        let pre = EncodedPre::Frames(Box::new(frames));
        self.encode_with(conditioning, NormalizedInput::new(conditioning), pre)
    }

    fn encode_with(
        &self,
        conditioning: &Conditioning,
        input: NormalizedInput,
        pre: EncodedPre,
    ) -> Encoded {
        let Conditioning { linear_estimate: u, sensor, frames, .. } = conditioning;
        Encoded {
            pre,
            low: self.low.encode(u.clone(), *frames),
            sensor: self.unet.encode(sensor.clone()),
            input,
            variance: conditioning.noise_variance(),
            u: u.clone(),
            frames: *frames,
        }
    }

    /// Pre-denoises once for all steps: only for networks whose pre-denoiser does not see simulated
    /// measurements.
    #[must_use]
    pub fn predenoise_once(&self, encoded: Encoded) -> Encoded {
        let frames = self.predenoise_with(&encoded, None);
        Encoded { pre: EncodedPre::Frames(Box::new(frames)), ..encoded }
    }

    /// Pre-denoises frames and gives their features.
    ///
    /// # Shapes
    /// - results: `[images, 1, height, width]` in image units, `[images, width, h, w]`
    pub fn predenoise_simulated(
        &self,
        conditioning: &Conditioning,
        simulated: Option<&Simulated>,
    ) -> (Tensor<4>, Tensor<4>) {
        let input = NormalizedInput::new(conditioning);
        let pre = self.pre.encode(&input);
        self.predenoise_encoded(pre, &input, simulated, conditioning.frames)
    }

    /// Predicts the clean frames. `flows` are those of an earlier step; estimated if there are none.
    pub fn forward(
        &self,
        encoded: &Encoded,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: Option<Flows>,
    ) -> Prediction {
        let (fused, flows) = self.fuse(encoded, simulated, state, flows, &mut |_| ());
        let (x0, unit) = self.predict(&fused);
        Prediction { x0, unit, d: fused.d, flows }
    }

    /// Pre-denoises frames alone, in image units, before any simulated measurement, with their predicted
    /// uncertainty where the network has a head for it. No gradient goes from the uncertainty to anything but
    /// that head.
    ///
    /// # Shapes
    /// - results: `[images, 1, height, width]`
    pub fn predenoise(&self, conditioning: &Conditioning) -> (Tensor<4>, Option<Tensor<4>>) {
        self.predenoise_normalized(&NormalizedInput::new(conditioning))
    }

    /// [`Self::predenoise`] for networks with a reference estimate, which need no more than aligned frames.
    pub fn predenoise_aligned(&self, aligned: &AlignedTensors) -> (Tensor<4>, Option<Tensor<4>>) {
        self.predenoise_normalized(&NormalizedInput::aligned(aligned))
    }

    fn predenoise_normalized(&self, input: &NormalizedInput) -> (Tensor<4>, Option<Tensor<4>>) {
        let (d, features) = self.pre.predenoise_normalized(input);
        (d, self.uncertainty.as_ref().map(|head| head.forward(features.detach(), input)))
    }

    /// Whether the network predicts the uncertainty of its pre-denoised frames.
    pub fn predicts_uncertainty(&self) -> bool {
        self.uncertainty.is_some()
    }

    /// The network with the uncertainty head of another one of the same sizes.
    #[must_use]
    pub fn with_uncertainty_head_of(self, other: Self) -> Self {
        Self { uncertainty: other.uncertainty, ..self }
    }

    /// The same weights in a network whose flow and fusion are left out where `config` says so. Parts that are left out
    /// still have weights, so nothing is lost.
    #[must_use]
    pub fn ablated(mut self, config: &NetworkConfig) -> Self {
        self.flow.off = config.ablates(Part::Flow);
        self.fusion.ablated = config.ablates(Part::Fusion);
        self
    }

    /// The pre-denoisers of the refinement stages, in their order.
    pub fn stages(&self) -> &[PreDenoiser] {
        &self.stages
    }

    /// Adds a refinement stage: the pre-denoiser becomes that stage, and a copy of it that sees `more`
    /// aligned neighbours, of zero weight at first, becomes the pre-denoiser.
    #[must_use]
    pub fn with_stage_added(mut self, more: usize) -> Self {
        self.stages.push(self.pre.clone());
        self.pre = self.pre.with_more_neighbours(more);
        self
    }

    /// The pre-denoised frames before any simulated measurement, and the flows between them; nothing else is
    /// computed. No gradient goes from the flows to the frames.
    pub fn predenoise_and_align(&self, encoded: &Encoded) -> (Tensor<4>, Flows) {
        let (d, _) = self.predenoise_with(encoded, None);
        let flows = self.estimate_flow(encoded, d.clone().detach());
        (d, flows)
    }

    fn estimate_flow(&self, encoded: &Encoded, d: Tensor<4>) -> Flows {
        let reference = encoded.input.start.clone();
        self.flow.forward(d, reference, encoded.variance.clone(), encoded.frames)
    }

    /// Sigma of the pre-denoised frames' errors in image units: as predicted, else some tenths of the merged
    /// frames' noise.
    fn error_sigma(&self, features: &Tensor<4>, input: &NormalizedInput) -> Tensor<4> {
        match &self.uncertainty {
            Some(head) => head.forward(features.clone().detach(), input).detach(),
            None => input.sigma.clone() * CORRECTION,
        }
    }

    /// The pre-denoised frames and their features.
    fn predenoise_with(
        &self,
        encoded: &Encoded,
        simulated: Option<&Simulated>,
    ) -> (Tensor<4>, Tensor<4>) {
        let Encoded { pre, input, frames, .. } = encoded;
        match pre.clone() {
            EncodedPre::Inputs(pre) => self.predenoise_encoded(*pre, input, simulated, *frames),
            EncodedPre::Frames(frames) => *frames,
        }
    }

    fn predenoise_encoded(
        &self,
        pre: Tensor<4>,
        input: &NormalizedInput,
        simulated: Option<&Simulated>,
        frames: usize,
    ) -> (Tensor<4>, Tensor<4>) {
        let start = &input.start;
        let bursts = start.dims()[0] / frames;
        let (y_sim, u_sim, flags) = match simulated {
            Some(simulated) => {
                let flags = simulated.exists.iter().map(|&exists| f32::from(u8::from(exists)));
                (simulated.y.clone(), simulated.u.clone(), flags.collect())
            }
            None => (start.zeros_like(), start.zeros_like(), vec![0.0; bursts]),
        };
        let flag = per_image(flags, bursts * frames, &start.device());
        let both = Tensor::cat(vec![y_sim, u_sim], 1);
        self.pre.forward(pre, input, both, flag)
    }

    /// Computes all but the U-Net, and calls `done` with the name of every block that is done.
    pub fn fuse(
        &self,
        encoded: &Encoded,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: Option<Flows>,
        done: &mut dyn FnMut(&'static str),
    ) -> (Fused, Flows) {
        let frames = encoded.frames;
        let u = encoded.u.clone();
        let u_sim = simulated.map_or_else(|| u.zeros_like(), |simulated| simulated.u.clone());
        let (d, features) = self.predenoise_with(encoded, simulated);
        done("pre");
        let low = self.low.forward(encoded.low.clone(), u_sim, d.clone(), frames);
        done("low");
        let input = encoded.input.clone();
        // A sigma spans twice as much in [-1, 1].
        let sigma = self.error_sigma(&features, &input) * 2.0;
        let noisy = Preconditioned::new(d.clone() * 2.0 - 1.0, sigma.clone(), state);
        let [image, previous] = match self.noisy {
            NoisyFeatures::Image => [state.x_t.clone(), state.previous()],
            NoisyFeatures::Residual => [noisy.residual.clone(), noisy.previous.clone()],
        };
        let high = self.high.forward(image, previous, frames);
        done("high");
        let flows = flows.unwrap_or_else(|| self.estimate_flow(encoded, d.clone()));
        done("flow");
        let pyramid = self.fusion.forward(low, high, features, &flows, frames);
        done("fusion");
        let (sensor, state, noisy) = (encoded.sensor.clone(), state.clone(), Some(noisy));
        (Fused { pyramid, d, sigma, noisy, input, sensor, state, frames }, flows)
    }

    /// The clean image, about in [-1, 1], and the unit of a correction ([`Prediction`]).
    ///
    /// # Shapes
    /// - results: `[images, 1, height, width]`
    pub fn predict(&self, fused: &Fused) -> (Tensor<4>, Tensor<4>) {
        let Fused { pyramid, input, sensor, state, frames, .. } = fused;
        let noisy = fused.noisy();
        let images = self.predicts.images(&noisy, state, input);
        let (pyramid, sensor) = (pyramid.clone(), sensor.clone());
        let output = self.unet.forward(images, pyramid, &state.timesteps, sensor, *frames);
        match self.predicts {
            UNetPrediction::X0 => (output, noisy.c_out),
            UNetPrediction::Edm => (noisy.clone().prediction(output), noisy.c_out),
            UNetPrediction::Correction => (noisy.mean + output * noisy.sigma.clone(), noisy.sigma),
        }
    }

    /// Whether the U-Net sees the frames of a burst together.
    pub fn attends_over_time(&self) -> bool {
        self.unet.attends_over_time()
    }
}
