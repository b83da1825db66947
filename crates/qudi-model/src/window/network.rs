//! The whole network: a window is encoded once, every reverse step predicts from that.

use super::agreement::Agreement;
use super::config::WindowConfig;
use super::encoding::EncodedWindow;
use super::fusion::Fusion;
use super::initial::initial_values;
use super::motion::flow::Flow;
use super::predenoiser::PreDenoiser;
use super::unet::{Outputs, StepImages, UNet};
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::{DiffusionState, per_image};
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_layers::init_parameters;

/// The largest difference from the base that the U-Net sees, in units of usual errors.
const MAX_DIFFERENCE: f32 = 6.0;

/// The network that encodes a window once.
#[derive(Module, Debug)]
pub struct Window {
    pub(super) pre: PreDenoiser,
    pub(super) flow: Flow,
    pub(super) fusion: Fusion,
    unet: UNet,
    agreement: Agreement,
    #[module(skip)]
    pub(super) state: usize,
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

impl Window {
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
        let EncodedWindow { restored, known, merged, sensor, error_sigma, .. } = encoded;
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
        let known = known.clone() * 2.0 - 1.0;
        let base = known * (has_previous * -1.0 + 1.0) + state.previous();
        let error_variance = error_sigma.clone().powi_scalar(2);
        let variance = error_variance.clone() + noise.clone().powi_scalar(2);
        let c_skip = error_variance.clone() / variance.clone() * seen.clone();
        let c_out =
            (noise.clone().powi_scalar(2) * error_sigma.clone().powi_scalar(2) / variance).sqrt();
        let c_out = c_out * seen.clone() + error_sigma.clone() * (seen * -1.0 + 1.0);
        let difference = (state.x_t.clone() * signal - base.clone()) * c_skip;
        let clamped =
            |x: Tensor<4>| (x / error_sigma.clone()).clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE);
        let mean = merged.mean.clone() * 2.0 - 1.0;
        // Variance of the merged frames' noise in [-1, 1].
        let merged_variance = encoded.noise_variance.clone() * 4.0 / merged.frames.clone();
        let step = StepImages {
            noisy: clamped(difference.clone()),
            previous: clamped(base.clone() - predenoised),
            merged: clamped(mean.clone() - base.clone()),
            noise: (error_variance / merged_variance).log(),
        };
        let log_snr: Vec<f32> = state
            .timesteps
            .iter()
            .map(|&t| {
                let bar = schedule.alpha_bar(Some(t));
                ((bar / (1.0 - bar)).ln() as f32).clamp(-10.0, 10.0)
            })
            .collect();
        let Outputs { correction, gate, features } =
            self.unet.forward(encoded, step, sensor.clone(), &log_snr);
        let seen = base + difference;
        // The less noise the noisy image has, the less the merged frames count.
        let gate = gate * (c_out.clone() / error_sigma.clone());
        let single = seen.clone() + (mean - seen) * gate + correction * c_out.clone();
        let x0 = self.agreement.forward(single, features, &c_out, &encoded.paths);
        WindowPrediction { x0, c_out }
    }
}
