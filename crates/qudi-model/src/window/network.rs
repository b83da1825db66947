//! The whole network: a window is encoded once, every reverse step predicts from that.

use super::agreement::{Agreement, Paths};
use super::config::{FOLD, WindowConfig};
use super::flow::{Flow, WindowFlow};
use super::fusion::{Frames, Fused, Fusion};
use super::hourglass::normalized;
use super::initial::initial_values;
use super::input::{MIDDLE, Measurement};
use super::predenoiser::PreDenoiser;
use super::refinement::{flow_between, refined};
use super::unet::{StepImages, UNet};
use crate::diffusion::Conditioning;
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::{DiffusionState, per_image};
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::init_parameters;
use qudi_layers::resample::pixel_unshuffle;

/// Scale of pre-denoised frames around the middle level among the inputs of the U-Net.
const SCALE: f32 = 3.0;

/// The largest difference from the base that the U-Net sees, in units of usual errors.
const MAX_DIFFERENCE: f32 = 6.0;

/// The network that encodes a window once.
#[derive(Module, Debug)]
pub struct Window {
    pre: PreDenoiser,
    flow: Flow,
    fusion: Fusion,
    unet: UNet,
    agreement: Agreement,
    #[module(skip)]
    state: usize,
}

/// A window as U-Net and agreement see it in every step.
#[derive(Clone, Debug)]
pub struct EncodedWindow {
    /// Pre-denoised frames in image units, `[bursts * frames, 1, H, W]`.
    pub restored: Tensor<4>,
    /// Learnt flow on all levels, finest first. Fusion and agreement follow the refined one.
    pub flow: Vec<WindowFlow>,
    /// Linear estimates merged along the flow, in image units, `[bursts * frames, 1, H, W]`.
    pub merged: Tensor<4>,
    paths: Paths,
    features: Vec<Tensor<4>>,
    merged_planes: Tensor<4>,
    sensor: Tensor<4>,
    error_sigma: Tensor<4>,
}

/// The prediction of a reverse step.
#[derive(Clone, Debug)]
pub struct WindowPrediction {
    /// The clean image, about in [-1, 1]: `[bursts * frames, 1, H, W]`.
    pub x0: Tensor<4>,
    /// Scale of the U-Net's correction (`c_out`, Karras et al. 2022), `[bursts * frames, 1, 1, 1]`.
    pub c_out: Tensor<4>,
}

impl WindowConfig {
    /// Creates the network with initial weights of `seed`, the same on every device. The sizes must be
    /// [checked](Self::checked).
    pub fn init(&self, seed: u64, device: &Device) -> Window {
        let initial = |name: &str, shape: &[usize]| initial_values(seed, name, shape);
        init_parameters(self.uninitialized(device), initial)
    }

    /// Creates the network without weights: it takes no memory yet.
    pub fn uninitialized(&self, device: &Device) -> Window {
        Window {
            pre: self.init_predenoiser(device),
            flow: self.init_flow(device),
            fusion: self.init_fusion(device),
            unet: self.init_unet(device),
            agreement: Agreement::zeros(self.widths[0], device),
            state: self.state,
        }
    }
}

impl EncodedWindow {
    /// Returns features, states and pre-denoised frames, `[bursts * frames, channels, h, w]` each.
    pub(super) fn features(&self) -> &[Tensor<4>] {
        &self.features
    }

    /// Returns the planes of merged frames, `[bursts * frames, 8, h, w]`.
    pub(super) fn merged_planes(&self) -> &Tensor<4> {
        &self.merged_planes
    }

    /// Returns sigma of usual errors in [-1, 1], `[bursts * frames, 1, 1, 1]`.
    pub fn error_sigma(&self) -> &Tensor<4> {
        &self.error_sigma
    }

    /// Returns the memory of all tensors, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let single = [&self.restored, &self.merged, &self.merged_planes];
        let flows = self.flow.iter().map(|flow| &flow.pairs);
        let all = single.into_iter().chain(flows).chain(self.paths.tensors()).chain(&self.features);
        all.map(|x| x.shape().num_elements() * size_of::<f32>()).sum()
    }

    /// Returns the same outside autodiff.
    #[must_use]
    pub fn inner(&self) -> Self {
        let inner = |x: &Tensor<4>| x.clone().inner();
        let flow = |flow: &WindowFlow| WindowFlow { pairs: inner(&flow.pairs), ..*flow };
        Self {
            restored: inner(&self.restored),
            merged: inner(&self.merged),
            merged_planes: inner(&self.merged_planes),
            flow: self.flow.iter().map(flow).collect(),
            paths: self.paths.inner(),
            features: self.features.iter().map(inner).collect(),
            sensor: inner(&self.sensor),
            error_sigma: inner(&self.error_sigma),
        }
    }
}

impl Window {
    /// Encodes a window. Every pass after the first one finds the flow anew, between the clean frames that
    /// the pass before predicts, and fuses the frames along it.
    pub fn encode(&self, conditioning: &Conditioning, passes: usize) -> EncodedWindow {
        let frames = conditioning.frames;
        let measurement = Measurement::new(conditioning);
        let (restored, pyramid) = self.pre.forward(&measurement);
        let learnt = self.flow.forward(&restored, &pyramid, frames);
        let features = normalized(pyramid[0].clone());
        let folded = pixel_unshuffle(restored.clone(), FOLD);
        let fused = |found: &WindowFlow| {
            let window = Frames {
                whole: [&restored, &conditioning.linear_estimate],
                restored: &folded,
                linear: &measurement.linear,
                features: &features,
                count: frames,
            };
            let Fused { states: [earlier, later], merged } =
                self.fusion.forward(&window, found, self.state);
            let image = (folded.clone() - MIDDLE) * SCALE;
            EncodedWindow {
                merged_planes: merged.planes(),
                merged: merged.mean,
                restored: restored.clone(),
                paths: Paths::new(found, frames),
                flow: learnt.clone(),
                features: vec![features.clone(), earlier, later, image],
                sensor: measurement.sensor.clone(),
                error_sigma: measurement.error_sigma.clone(),
            }
        };
        let mut found = refined(&restored, &measurement.error_sigma, &learnt[0], frames);
        let mut encoded = fused(&found);
        for _ in 1..passes {
            let clean = self.posterior_mean(&encoded, frames);
            found = flow_between(clean, &found, frames);
            encoded = fused(&found);
        }
        encoded
    }

    /// Predicts the clean frames in image units from the measurement alone.
    fn posterior_mean(&self, encoded: &EncodedWindow, frames: usize) -> Tensor<4> {
        let restored = &encoded.restored;
        let bursts = restored.dims()[0] / frames;
        let state = DiffusionState {
            x_t: restored.zeros_like(),
            x0_prev: restored.zeros_like(),
            has_previous: vec![false; bursts],
            timesteps: vec![NUM_TIMESTEPS - 1; bursts],
        };
        let prediction = self.predict(encoded, &state, &NoiseSchedule::cosine(NUM_TIMESTEPS));
        (prediction.x0 + 1.0) * 0.5
    }

    /// Predicts the clean frames from an encoded window and the noisy image.
    ///
    /// At the noisiest timestep the noisy image says nothing and is not looked at: the prediction is the
    /// posterior mean, whatever the noise.
    pub fn predict(
        &self,
        encoded: &EncodedWindow,
        state: &DiffusionState,
        schedule: &NoiseSchedule,
    ) -> WindowPrediction {
        let EncodedWindow { restored, sensor, error_sigma, .. } = encoded;
        let images = restored.dims()[0];
        let device = restored.device();
        let of_steps = |f: &dyn Fn(f64) -> f64| {
            let values = state.timesteps.iter().map(|&t| f(schedule.alpha_bar(Some(t))) as f32);
            per_image(values.collect(), images, &device)
        };
        let last = NUM_TIMESTEPS - 1;
        let seen: Vec<f32> =
            state.timesteps.iter().map(|&t| f32::from(u8::from(t < last))).collect();
        let seen = per_image(seen, images, &device);
        // Noise of the image over its signal, `sigma` of Karras et al. 2022.
        let noise = of_steps(&|bar| ((1.0 - bar) / bar).sqrt());
        let signal = of_steps(&|bar| 1.0 / bar.sqrt());
        let predenoised = restored.clone() * 2.0 - 1.0;
        let has_previous = state.has_previous_flag();
        let base = predenoised.clone() * (has_previous.clone() * -1.0 + 1.0) + state.previous();
        let error_variance = error_sigma.clone().powi_scalar(2);
        let variance = error_variance.clone() + noise.clone().powi_scalar(2);
        let c_skip = error_variance / variance.clone() * seen.clone();
        let c_out =
            (noise.clone().powi_scalar(2) * error_sigma.clone().powi_scalar(2) / variance).sqrt();
        let c_out = c_out * seen.clone() + error_sigma.clone() * (seen * -1.0 + 1.0);
        let difference = (state.x_t.clone() * signal - base.clone()) * c_skip;
        let clamped =
            |x: Tensor<4>| (x / error_sigma.clone()).clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE);
        let step = StepImages {
            noisy: clamped(difference.clone()),
            previous: clamped((base.clone() - predenoised) * has_previous),
        };
        let log_snr: Vec<f32> = state
            .timesteps
            .iter()
            .map(|&t| {
                let bar = schedule.alpha_bar(Some(t));
                ((bar / (1.0 - bar)).ln() as f32).clamp(-10.0, 10.0)
            })
            .collect();
        let (correction, features) =
            self.unet.forward(encoded, step, sensor.clone(), &log_snr, &state.has_previous);
        let single = base + difference + correction * c_out.clone();
        let x0 = self.agreement.forward(single, features, &c_out, &encoded.paths);
        WindowPrediction { x0, c_out }
    }
}
