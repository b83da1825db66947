//! The whole network: pre-denoiser, features, flow, fusion, U-Net.

use super::error::ErrorHead;
use super::evidence::Evidence;
use super::features::{HighFeatures, LowFeatures};
use super::flow::{Flow, Flows};
use super::fusion::Fusion;
use super::layers::CORRECTION;
use super::pre::PreDenoiser;
use super::unet::UNet;
use super::variance::mean_variance;
use crate::config::{NetworkConfig, Part};
use crate::diffusion::precondition::Preconditioned;
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::Result;

/// What was measured, `[bursts * frames, 1, height, width]`.
#[derive(Clone, Debug)]
pub struct Measured {
    /// The linear estimate in image units.
    pub u: Tensor<4>,
    /// What classical methods make of it, `[bursts * frames, planes, height, width]`
    /// ([`GuidePlanes`](crate::measurement::GuidePlanes)), with the network's number of neighbours.
    pub guide: Tensor<4>,
    /// Numbers of sensor and light, `[bursts, 11]`.
    pub sensor: Tensor<2>,
    /// Frames of a burst.
    pub frames: usize,
}

/// The simulated measurement of the last estimate.
#[derive(Clone, Debug)]
pub struct Simulated {
    /// Counts over full scale.
    pub y: Tensor<4>,
    /// Their linear estimate in image units.
    pub u: Tensor<4>,
    /// For every burst, whether it has one; both are zero where not.
    pub exists: Vec<bool>,
}

/// Where the diffusion stands.
#[derive(Clone, Debug)]
pub struct State {
    /// The noisy image, `[bursts * frames, 1, height, width]`.
    pub x_t: Tensor<4>,
    /// The previous estimate of the clean image, in [-1, 1].
    pub x0_prev: Tensor<4>,
    /// For every burst, whether it has one.
    pub known: Vec<bool>,
    /// Diffusion time of every burst.
    pub times: Vec<usize>,
}

/// What the network makes of a burst's measurement alone, the same in every step.
#[derive(Clone, Debug)]
pub struct Prepared {
    pre: Tensor<4>,
    low: Tensor<4>,
    sensor: Tensor<2>,
    u: Tensor<4>,
    evidence: Evidence,
    /// Variance of the noise of `u` at the mean light, `[images, 1, 1, 1]`.
    variance: Tensor<4>,
    frames: usize,
    /// The pre-denoised frames and their features, where no simulated measurement changes them ([`Qudi::denoise_once`]).
    denoised: Option<(Tensor<4>, Tensor<4>)>,
}

/// What the network says.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// The clean image, about in [-1, 1].
    pub x0: Tensor<4>,
    /// Deviation of what would be unknown of it if errors of the pre-denoised frames were white.
    pub unit: Tensor<4>,
    /// The pre-denoised frames, in image units.
    pub d: Tensor<4>,
    /// The flows that were used.
    pub flows: Flows,
}

/// See the module.
#[derive(Module, Debug)]
pub struct Qudi {
    /// Pre-denoisers of the rounds before the last: they make what the guide is found from, and learn no more.
    drafts: Vec<PreDenoiser>,
    pre: PreDenoiser,
    error: Option<ErrorHead>,
    low: LowFeatures,
    high: HighFeatures,
    flow: Flow,
    fusion: Fusion,
    unet: UNet,
}

impl NetworkConfig {
    /// The network with initial weights of `seed`, the same on every device. The sizes must be
    /// [checked](Self::checked).
    pub fn init(&self, seed: u64, device: &Device) -> Qudi {
        let initial = |name: &str, shape: &[usize]| super::weights::initial(seed, name, shape);
        super::fill(self.shell(device), initial)
    }

    /// The network without weights: it takes no memory yet.
    pub fn shell(&self, device: &Device) -> Qudi {
        let draft = |_| self.pre.of_drafts().init(self.fold, device);
        Qudi {
            drafts: (1..self.pre.rounds).map(draft).collect(),
            pre: self.pre.init(self.fold, device),
            error: self.pre.init_error(self.fold, device),
            low: self.features.init_low(self.fold, device),
            high: self.features.init_high(self.fold, device),
            flow: self.flow.init(self.lacks(Part::Flow), device),
            fusion: self.fusion.init(&self.features, self.pre.width, self.fold, device),
            unet: self.unet.init(&self.fusion, self.fold, device),
        }
    }
}

impl Qudi {
    /// Whether the picture depends on the noise that sampling starts from. It does not where only the pre-denoiser has
    /// learnt: the U-Net's correction starts at zero.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the device fails.
    pub fn generates(&self) -> Result<bool> {
        self.unet.corrects()
    }

    /// Computes what does not depend on the step.
    pub fn prepare(&self, measured: &Measured) -> Prepared {
        let u = measured.u.clone();
        let evidence = Evidence::new(&measured.guide);
        Prepared {
            pre: self.pre.prepare(&evidence),
            low: self.low.prepare(u.clone(), measured.frames),
            sensor: self.unet.prepare(measured.sensor.clone()),
            evidence,
            variance: mean_variance(&measured.sensor, measured.frames),
            u,
            frames: measured.frames,
            denoised: None,
        }
    }

    /// Whether simulated measurements change the pre-denoised frames. They do not where the pre-denoiser has learnt before the
    /// rest.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the device fails.
    pub fn denoises_anew(&self) -> Result<bool> {
        self.pre.sees_simulated()
    }

    /// Denoises once for all steps; only where [`Self::denoises_anew`] is false.
    #[must_use]
    pub fn denoise_once(&self, prepared: Prepared) -> Prepared {
        let Prepared { pre, evidence, frames, .. } = &prepared;
        let denoised = self.pre_denoise(pre, evidence, *frames, None);
        Prepared { denoised: Some(denoised), ..prepared }
    }

    /// Predicts the clean frames. `flows` are those of an earlier step; estimated if there are none.
    pub fn forward(
        &self,
        prepared: &Prepared,
        simulated: Option<&Simulated>,
        state: &State,
        flows: Option<Flows>,
    ) -> Prediction {
        self.forward_observed(prepared, simulated, state, flows, &mut |_| ())
    }

    /// The pre-denoised frames alone, in image units, of frames and their guide ([`Measured`]), before any simulated
    /// measurement: all there is where the U-Net does not correct them ([`Self::generates`]). With the deviation of their
    /// errors, `[images, 1, height, width]`, where the network tells it ([`Self::tells_errors`]); no gradient goes from that
    /// to anything but its own layers.
    pub fn denoise(&self, guide: &Tensor<4>) -> (Tensor<4>, Option<Tensor<4>>) {
        let evidence = Evidence::new(guide);
        let (d, features) = self.pre.denoise_seen(&evidence);
        (d, self.error.as_ref().map(|head| head.forward(features.detach(), &evidence)))
    }

    /// Whether the network tells how far its frames may be off.
    pub fn tells_errors(&self) -> bool {
        self.error.is_some()
    }

    /// The network with the layers of another one of the same sizes that tell its errors.
    #[must_use]
    pub fn with_error_of(self, other: Self) -> Self {
        Self { error: other.error, ..self }
    }

    /// What a burst's guide goes through before this network sees it, in their order.
    pub fn drafts(&self) -> &[PreDenoiser] {
        &self.drafts
    }

    /// The network with other drafts, as many as it has.
    #[must_use]
    pub fn with_drafts(self, drafts: Vec<PreDenoiser>) -> Self {
        Self { drafts, ..self }
    }

    /// The network for one round more, whose last pre-denoiser starts as a copy of what becomes a draft, and sees `more` frames laid
    /// upon each besides, which have no say yet.
    #[must_use]
    pub fn with_round_more(mut self, more: usize) -> Self {
        self.drafts.push(self.pre.clone());
        self.pre = self.pre.seeing_more(more);
        self
    }

    /// The pre-denoised frames before any simulated measurement, and the flows between them; nothing else is computed.
    /// No gradient goes from the flows to the frames.
    pub fn denoise_and_align(&self, prepared: &Prepared) -> (Tensor<4>, Flows) {
        let Prepared { pre, evidence, frames, .. } = prepared;
        let (d, _) = self.pre_denoise(pre, evidence, *frames, None);
        let flows = self.estimate_flow(prepared, d.clone().detach());
        (d, flows)
    }

    fn estimate_flow(&self, prepared: &Prepared, d: Tensor<4>) -> Flows {
        let clean = prepared.evidence.clean.clone();
        self.flow.forward(d, clean, prepared.variance.clone(), prepared.frames)
    }

    /// Deviation of the pre-denoised frames' errors in image units: as told, else some tenths of the merged frames' noise.
    fn errors(&self, features: &Tensor<4>, evidence: &Evidence) -> Tensor<4> {
        match &self.error {
            Some(head) => head.forward(features.clone().detach(), evidence).detach(),
            None => evidence.deviation.clone() * CORRECTION,
        }
    }

    /// The pre-denoised frames and their features.
    fn pre_denoise(
        &self,
        prepared: &Tensor<4>,
        evidence: &Evidence,
        frames: usize,
        simulated: Option<&Simulated>,
    ) -> (Tensor<4>, Tensor<4>) {
        let clean = &evidence.clean;
        let bursts = clean.dims()[0] / frames;
        let (y_sim, u_sim, flags) = match simulated {
            Some(simulated) => {
                let flags = simulated.exists.iter().map(|&exists| f32::from(u8::from(exists)));
                (simulated.y.clone(), simulated.u.clone(), flags.collect())
            }
            None => (clean.zeros_like(), clean.zeros_like(), vec![0.0; bursts]),
        };
        let flags = TensorData::new(flags, [bursts, 1, 1, 1]);
        let flag = Tensor::<4>::from_data(flags, &clean.device()).repeat_dim(1, frames);
        let flag = flag.reshape([bursts * frames, 1, 1, 1]);
        let both = Tensor::cat(vec![y_sim, u_sim], 1);
        self.pre.forward(prepared.clone(), evidence, both, flag)
    }

    /// [`Self::forward`], telling `done` the name of every block that is done.
    pub fn forward_observed(
        &self,
        prepared: &Prepared,
        simulated: Option<&Simulated>,
        state: &State,
        flows: Option<Flows>,
        done: &mut dyn FnMut(&'static str),
    ) -> Prediction {
        let frames = prepared.frames;
        let u = prepared.u.clone();
        let u_sim = simulated.map_or_else(|| u.zeros_like(), |simulated| simulated.u.clone());
        let (d, features) = prepared.denoised.clone().unwrap_or_else(|| {
            self.pre_denoise(&prepared.pre, &prepared.evidence, frames, simulated)
        });
        done("pre");
        let low = self.low.forward(prepared.low.clone(), u_sim, d.clone(), frames);
        done("low");
        let evidence = &prepared.evidence;
        // A deviation spans twice as much in [-1, 1].
        let error = self.errors(&features, evidence) * 2.0;
        let noisy = Preconditioned::new(d.clone() * 2.0 - 1.0, error, state);
        let high = self.high.forward(noisy.residual.clone(), noisy.earlier.clone(), frames);
        done("high");
        let flows = flows.unwrap_or_else(|| self.estimate_flow(prepared, d.clone()));
        done("flow");
        let fused = self.fusion.forward(low, high, features, &flows, frames);
        done("fusion");
        let (unit, sensor) = (noisy.unknown.clone(), prepared.sensor.clone());
        let x0 = self.unet.forward(noisy, evidence, fused, &state.times, sensor, frames);
        done("unet");
        Prediction { x0, unit, d, flows }
    }
}
