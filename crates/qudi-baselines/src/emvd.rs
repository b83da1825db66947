//! EMVD: efficient multi-stage video denoising with recurrent spatio-temporal fusion (Maggioni et al., CVPR
//! 2021), in the form in which it was compared with: frames as four equal channels, three levels of wavelets.

mod method;
mod transform;

use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use transform::{Inverse, Wavelet};

/// Channels of a frame.
pub const CHANNELS: usize = 4;

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 8;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Channels of the layers inside.
    pub width: usize,
}

/// Shot and read noise of raw frames of 12 bits, `a x + b`: constants of the published network.
const SHOT_NOISE: f32 = 1.0 / 3855.0;
const READ_NOISE: f32 = SHOT_NOISE * SHOT_NOISE;

/// The network: one step of a recurrence over frames.
#[derive(Module, Debug)]
pub struct Emvd {
    ct: Colours,
    cti: Colours,
    ft: Wavelet,
    fti: Inverse,
    vd: Stage,
    md1: Stage,
    md0: Stage,
    refine: Head,
}

/// A colour transform: a matrix.
#[derive(Module, Debug)]
struct Colours {
    net1: Conv2d,
}

/// Fusion and denoising of one level.
#[derive(Module, Debug)]
struct Stage {
    fusion: Head,
    denoise: Head,
}

/// Three convolutions.
#[derive(Module, Debug)]
struct Head {
    net1: Conv2d,
    net2: Conv2d,
    net3: Conv2d,
}

/// Results of a step.
///
/// # Shapes
/// - gamma, omega: `[images, 1, height / 2, width / 2]`
/// - fusion, denoise, refine: `[images, 4, height, width]`
#[derive(Clone, Debug)]
pub struct Step {
    /// The weight of the current frame in the fusion.
    pub gamma: Tensor<4>,
    /// The fusion of the previous and the current frame: the next step's previous frame.
    pub fusion: Tensor<4>,
    /// The fusion denoised.
    pub denoise: Tensor<4>,
    /// The weight of the fusion in the result.
    pub omega: Tensor<4>,
    /// The result.
    pub refine: Tensor<4>,
}

/// Results of a level, for the next finer one.
struct Level {
    gamma: Tensor<4>,
    fused: Tensor<4>,
    denoised: Tensor<4>,
    sigma: Tensor<4>,
}

impl Emvd {
    /// Makes the network with `width` channels inside, all weights zero.
    pub fn zeros(width: usize, device: &Device) -> Self {
        let colours = || Colours { net1: Conv2d::zeros([4, 4], 1, Bias::No, device) };
        Self {
            ct: colours(),
            cti: colours(),
            ft: Wavelet::zeros(device),
            fti: Inverse::zeros(device),
            vd: Stage::zeros([5, 21], width, device),
            md1: Stage::zeros([6, 25], width, device),
            md0: Stage::zeros([6, 25], width, device),
            refine: Head::zeros([33, 1], width, device),
        }
    }

    /// Fuses the `current` frame into what was fused before, or into itself at first, and denoises it.
    ///
    /// # Shapes
    /// - previous, current: `[images, 4, height, width]`, sides multiples of 8
    pub fn step(&self, previous: Tensor<4>, current: Tensor<4>) -> Step {
        let pyramid = |frame: Tensor<4>| {
            let finest = self.ft.forward(self.ct.net1.linear(&[frame]));
            let middle = self.ft.forward(low(&finest));
            let coarsest = self.ft.forward(low(&middle));
            [finest, middle, coarsest]
        };
        let (previous, current) = (pyramid(previous), pyramid(current));
        let mut coarser: Option<Level> = None;
        let stages = [&self.md0, &self.md1, &self.vd];
        for ((stage, before), now) in stages.into_iter().zip(&previous).zip(&current).rev() {
            let from = coarser.map(|level| (level.gamma, self.fti.forward(level.denoised)));
            coarser = Some(stage.forward(before, now, from));
        }
        let Level { gamma, fused, denoised, sigma } = coarser.expect("three levels");
        let omega = sigmoid(self.refine.forward(&[fused.clone(), denoised.clone(), sigma]));
        let refined = mix(denoised.clone(), fused.clone(), &omega);
        let image = |x| self.cti.net1.linear(&[self.fti.forward(x)]);
        Step {
            gamma,
            fusion: image(fused),
            denoise: image(denoised),
            omega,
            refine: image(refined),
        }
    }

    /// Restores every frame from itself and the frames before it.
    ///
    /// # Shapes
    /// - frames, results: `[images, 1, height, width]` each
    pub fn restore(&self, frames: Vec<Tensor<4>>) -> Vec<Tensor<4>> {
        // The copies are one picture.
        self.refined(frames).map(|image| image.mean_dim(1)).collect()
    }

    /// Computes the mean absolute error of every frame's four copies, `[1]`.
    ///
    /// # Shapes
    /// - frames, truth: `[images, 1, height, width]` each
    pub fn error(&self, frames: Vec<Tensor<4>>, truth: &[Tensor<4>]) -> Tensor<1> {
        let errors = self.refined(frames).zip(truth);
        let errors = errors.map(|(image, truth)| (image - truth.clone()).abs().mean());
        Tensor::cat(errors.collect(), 0).mean()
    }

    /// Returns the results, frame after frame, of four copies each.
    fn refined(&self, frames: Vec<Tensor<4>>) -> impl Iterator<Item = Tensor<4>> {
        let mut fused: Option<Tensor<4>> = None;
        frames.into_iter().map(move |frame| {
            let current = frame.repeat(&[1, CHANNELS, 1, 1]);
            let step = self.step(fused.take().unwrap_or_else(|| current.clone()), current);
            fused = Some(step.fusion);
            step.refine
        })
    }

    /// Computes the squared distance of the transforms from their inverses, `[1]`, which training adds to the
    /// error of the frames.
    pub fn transform_loss(&self) -> Tensor<1> {
        let of = |product: Tensor<2>| {
            let [rows, _] = product.dims();
            (product.clone() - Tensor::eye(rows, &product.device())).powi_scalar(2).sum()
        };
        let matrix = |colours: &Colours| colours.net1.weight().reshape([4, 4]);
        of(matrix(&self.ct).matmul(matrix(&self.cti)))
            + of(self.ft.matrix().matmul(self.fti.matrix()))
    }
}

impl Stage {
    fn zeros([fusion, denoise]: [usize; 2], width: usize, device: &Device) -> Self {
        Self {
            fusion: Head::zeros([fusion, 1], width, device),
            denoise: Head::zeros([denoise, 4 * CHANNELS], width, device),
        }
    }

    /// Fuses and denoises one level. `before` and `now` are wavelets of this level, `[images, 16, h, w]`;
    /// `coarser` the weight and the denoised image of the level below, the image on this level's grid.
    fn forward(
        &self,
        before: &Tensor<4>,
        now: &Tensor<4>,
        coarser: Option<(Tensor<4>, Tensor<4>)>,
    ) -> Level {
        let variance =
            |x: &Tensor<4>| x.clone().narrow(1, 0, 1).clamp(0.0, 1.0) * SHOT_NOISE + READ_NOISE;
        let (variance_before, variance_now) = (variance(before), variance(now));
        let mut inputs = vec![(low(now) - low(before)).abs()];
        if let Some((gamma, _)) = &coarser {
            inputs.push(qudi_layers::resample::repeat(gamma.clone()));
        }
        inputs.push(variance_now.clone());
        let gamma = sigmoid(self.fusion.forward(&inputs));
        let fused = mix(before.clone(), now.clone(), &gamma);
        let rest = gamma.clone().neg() + 1.0;
        let sigma =
            rest.powi_scalar(2) * variance_before + gamma.clone().powi_scalar(2) * variance_now;
        let mut inputs = vec![fused.clone()];
        inputs.extend(coarser.map(|(_, denoised)| denoised));
        inputs.extend([low(now), sigma.clone()]);
        let denoised = self.denoise.forward(&inputs);
        Level { gamma, fused, denoised, sigma }
    }
}

impl Head {
    fn zeros([inputs, outputs]: [usize; 2], width: usize, device: &Device) -> Self {
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device);
        Self {
            net1: conv([inputs, width]),
            net2: conv([width, width]),
            net3: conv([width, outputs]),
        }
    }

    fn forward(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        let x = self.net2.relu(&[self.net1.relu(inputs)]);
        self.net3.linear(&[x])
    }
}

/// Returns the coarse image in wavelets.
fn low(wavelets: &Tensor<4>) -> Tensor<4> {
    wavelets.clone().narrow(1, 0, CHANNELS)
}

/// Mixes `a`, where the weight is 0, and `b`, where it is 1.
fn mix(a: Tensor<4>, b: Tensor<4>, weight: &Tensor<4>) -> Tensor<4> {
    a * (weight.clone().neg() + 1.0) + b * weight.clone()
}
