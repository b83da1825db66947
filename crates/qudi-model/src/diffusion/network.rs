//! The whole network: pre-denoiser, features, flow, fusion, U-Net (docs/network.md).

pub(crate) mod attention;
pub(crate) mod embedding;
pub(crate) mod features;
pub(crate) mod flow;
pub(crate) mod fused;
pub(crate) mod fusion;
pub(crate) mod input;
pub(crate) mod predenoiser;
pub(crate) mod unet;

use super::precondition::Preconditioned;
use super::state::{DiffusionState, per_image};
use super::{Ablation, Conditioning, DiffusionConfig, NoisyFeatures, Part, UNetPrediction};
use crate::initial::initial_values;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use features::{HighFeatures, LowFeatures};
use flow::Flow;
use fusion::Fusion;
use input::NormalizedInput;
use predenoiser::PreDenoiser;
use qudi_layers::init_parameters;
use unet::UNet;

pub use flow::Flows;
pub use fused::{Fused, FusedGradient};

/// Sigma of the pre-denoised frames' errors, in sigmas of the linear estimate's noise.
const ERROR_SIGMA: f32 = 0.3;

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
    /// True for each burst that has one; both tensors are zero where not.
    pub exists: Vec<bool>,
}

impl Simulated {
    /// Returns the measurement of image `number` alone, of bursts of `frames` frames.
    #[must_use]
    pub fn image(&self, number: usize, frames: usize) -> Self {
        let one = |images: &Tensor<4>| images.clone().narrow(0, number, 1);
        Self { y: one(&self.y), u: one(&self.u), exists: vec![self.exists[number / frames]] }
    }

    /// Returns the same measurement outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        let inner = |images: &Tensor<4>| images.clone().inner();
        Self { y: inner(&self.y), u: inner(&self.u), exists: self.exists.clone() }
    }
}

/// A burst's conditioning as the network encodes it, the same in every reverse step.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// For the pre-denoiser.
    pre: Tensor<4>,
    /// For all that comes after it.
    pub measurement: EncodedMeasurement,
}

/// The encoded conditioning without the pre-denoiser's part.
#[derive(Clone, Debug)]
pub struct EncodedMeasurement {
    low: Tensor<4>,
    sensor: Tensor<2>,
    input: NormalizedInput,
    frames: usize,
}

impl Encoded {
    /// Returns the memory of all tensors, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let EncodedMeasurement { low, input, .. } = &self.measurement;
        let planes = [&input.linear_estimate, &input.sigma, &input.counts, &input.planes];
        let all = [&self.pre, low].into_iter().chain(planes);
        all.map(|x| x.shape().num_elements() * size_of::<f32>()).sum()
    }
}

/// Pre-denoised frames.
#[derive(Clone, Debug)]
pub struct Predenoised {
    /// The frames in image units, `[images, 1, height, width]`.
    pub d: Tensor<4>,
    /// Features, `[images, width, h, w]`.
    pub features: Tensor<4>,
}

/// The network's prediction.
///
/// # Shapes
/// - x0, d: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Prediction {
    /// The clean image, about in [-1, 1].
    pub x0: Tensor<4>,
    /// The pre-denoised frames, in image units.
    pub d: Tensor<4>,
    /// The flows that were used.
    pub flows: Flows,
}

/// The network of the diffusion.
#[derive(Module, Debug)]
pub struct Diffusion {
    pre: PreDenoiser,
    low: LowFeatures,
    high: HighFeatures,
    flow: Flow,
    fusion: Fusion,
    unet: UNet,
    #[module(skip)]
    noisy: NoisyFeatures,
    #[module(skip)]
    predicts: UNetPrediction,
    #[module(skip)]
    ablation: Ablation,
}

impl DiffusionConfig {
    /// Creates the network with initial weights of `seed`, the same on every device. The sizes must be
    /// [checked](Self::checked).
    pub fn init(&self, seed: u64, device: &Device) -> Diffusion {
        let initial = |name: &str, shape: &[usize]| initial_values(seed, name, shape);
        init_parameters(self.uninitialized(device), initial)
    }

    /// Creates the network without weights: it takes no memory yet.
    pub fn uninitialized(&self, device: &Device) -> Diffusion {
        Diffusion {
            pre: self.pre.init(self.fold, device),
            low: self.features.init_low(self.fold, device),
            high: self.features.init_high(self.fold, device),
            flow: self.flow.init(device),
            fusion: self.fusion.init(&self.features, self.pre.width, self.fold, device),
            unet: self.unet.init(&self.fusion, self.fold, device),
            noisy: self.features.noisy,
            predicts: self.unet.predicts,
            ablation: Ablation::default(),
        }
    }
}

impl Diffusion {
    /// Returns the same weights in a network that leaves parts out.
    #[must_use]
    pub fn ablated(self, ablation: &Ablation) -> Self {
        Self { ablation: ablation.clone(), ..self }
    }

    /// Returns the parts that are left out.
    pub fn ablation(&self) -> &Ablation {
        &self.ablation
    }

    /// Encodes what does not depend on the step.
    pub fn encode(&self, conditioning: &Conditioning) -> Encoded {
        let measurement = self.encode_measurement(conditioning);
        Encoded { pre: self.pre.encode(&measurement.input), measurement }
    }

    /// [Encodes](Self::encode) all but the pre-denoiser's part.
    pub fn encode_measurement(&self, conditioning: &Conditioning) -> EncodedMeasurement {
        let Conditioning { linear_estimate, sensor, frames, .. } = conditioning;
        EncodedMeasurement {
            low: self.low.encode(linear_estimate.clone(), *frames),
            sensor: self.unet.encode(sensor.clone()),
            input: NormalizedInput::new(conditioning),
            frames: *frames,
        }
    }

    /// Pre-denoises frames and computes their features.
    pub fn predenoise(
        &self,
        conditioning: &Conditioning,
        simulated: Option<&Simulated>,
    ) -> Predenoised {
        let input = NormalizedInput::new(conditioning);
        let encoded = self.pre.encode(&input);
        self.predenoise_encoded(encoded, &input, simulated, conditioning.frames)
    }

    /// Predicts the clean frames. `flows` come from an earlier step; they are estimated if there are none.
    pub fn forward(
        &self,
        encoded: &Encoded,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: Option<Flows>,
    ) -> Prediction {
        let Encoded { pre, measurement } = encoded;
        let EncodedMeasurement { input, frames, .. } = measurement;
        let predenoised = self.predenoise_encoded(pre.clone(), input, simulated, *frames);
        let (fused, flows) = self.fuse(measurement, predenoised, simulated, state, flows);
        let (x0, _) = self.predict(&fused);
        Prediction { x0, d: fused.d, flows }
    }

    fn predenoise_encoded(
        &self,
        encoded: Tensor<4>,
        input: &NormalizedInput,
        simulated: Option<&Simulated>,
        frames: usize,
    ) -> Predenoised {
        let start = &input.linear_estimate;
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
        let (d, features) = self.pre.forward(encoded, input, both, flag);
        Predenoised { d, features }
    }

    /// Computes all between pre-denoiser and U-Net.
    pub fn fuse(
        &self,
        measurement: &EncodedMeasurement,
        predenoised: Predenoised,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: Option<Flows>,
    ) -> (Fused, Flows) {
        let EncodedMeasurement { low, sensor, input, frames } = measurement;
        let Predenoised { d, features } = predenoised;
        let u_sim = simulated.map_or_else(|| d.zeros_like(), |simulated| simulated.u.clone());
        let low = self.low.forward(low.clone(), u_sim, d.clone(), *frames);
        // A sigma spans twice as much in [-1, 1].
        let sigma = input.sigma.clone() * ERROR_SIGMA * 2.0;
        let noisy = Preconditioned::new(d.clone() * 2.0 - 1.0, sigma.clone(), state);
        let [image, previous] = match self.noisy {
            NoisyFeatures::Image => [state.x_t.clone(), state.previous()],
            NoisyFeatures::Residual => [noisy.residual.clone(), noisy.previous.clone()],
        };
        let high = self.high.forward(image, previous, *frames);
        let flows = flows.unwrap_or_else(|| {
            let still = self.ablation.removes(Part::Flow);
            if still { self.flow.still(&d) } else { self.flow.forward(d.clone(), *frames) }
        });
        let alone = self.ablation.removes(Part::Fusion);
        let pyramid = self.fusion.forward(low, high, features, &flows, *frames, alone);
        let signed = input.linear_estimate.clone() * 2.0 - 1.0;
        let measured = Tensor::cat(vec![signed, input.counts.clone()], 1);
        let (sensor, state, noisy) = (sensor.clone(), state.clone(), Some(noisy));
        let fused = Fused { pyramid, d, sigma, noisy, measured, sensor, state, frames: *frames };
        (fused, flows)
    }

    /// Predicts the clean image, about in [-1, 1], and the scale of the U-Net's correction: sigma of the
    /// remaining error of the pre-denoised frames.
    ///
    /// # Shapes
    /// - results: `[images, 1, height, width]`
    pub fn predict(&self, fused: &Fused) -> (Tensor<4>, Tensor<4>) {
        let Fused { pyramid, measured, sensor, state, .. } = fused;
        let noisy = fused.noisy();
        let images = self.predicts.images(&noisy, state, measured);
        let (pyramid, sensor) = (pyramid.clone(), sensor.clone());
        let output = self.unet.forward(images, pyramid, &state.timesteps, sensor);
        match self.predicts {
            UNetPrediction::X0 => (output, noisy.c_out),
            UNetPrediction::Correction => (noisy.mean + output * noisy.sigma.clone(), noisy.sigma),
        }
    }
}
