//! What training minimises: squared error and differences of gradients of the pre-denoised frames, relative to the error of the
//! guide (DESIGN 4.8), and the squared error of the prediction in units of what is unknown of every pixel (Karras et al. 2022,
//! table 1, "EDM": their weight `1 / c_out^2`).

use crate::perceptual::Perceptual;
use burn::module::Module;
use burn::tensor::Tensor;
use qudi_core::restorer::Acquisition;
use qudi_core::{Result, SimError, Size};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_model::diffusion::physics::LoopSensor;
use qudi_model::diffusion::sampler::TIMES;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::measurement::Planes;
use qudi_model::network::{Measured, Qudi, Simulated, State};
use qudi_model::tensor::{read, to_tensor};

/// Weight of the total variation of the error.
const VARIATION: f32 = 0.01;

/// Least squared error that a guide counts with: better ones leave nothing to learn.
const LEAST_ERROR: f32 = 1e-4;

/// Least deviation that a pixel's error is counted in, in [-1, 1]: half a step of 8 bits.
const LEAST_UNIT: f32 = 0.004;

/// [`reconstruction`] of an example's images, with errors in the root of the guide's mean squared error over the burst: else
/// a few dark bursts, whose errors are thirty times those of bright ones, would be all that matters.
fn relative_reconstruction(example: &Example<'_>) -> impl Fn(Tensor<4>) -> Tensor<1> + use<> {
    let (guide, frames) = (example.measured.guide.clone(), example.measured.frames);
    let error = (guide.narrow(1, 0, 1) - example.truth.clone()).detach();
    let [images, _, height, width] = error.dims();
    let bursts = images / frames;
    let error = error.powi_scalar(2).reshape([bursts, frames * height * width]).mean_dim(1);
    let scale = error.clamp_min(LEAST_ERROR).sqrt().recip();
    let scale = scale.repeat_dim(1, frames).reshape([images, 1, 1, 1]);
    let truth = example.truth.clone() * scale.clone();
    move |estimate| reconstruction(estimate * scale.clone(), truth.clone())
}

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of the prediction.
    pub prediction: f32,
    /// Of the pre-denoised frames.
    pub pre: f32,
    /// Of the perceptual term, if there is one.
    pub perceptual: f32,
    /// Of the flows' misfit.
    pub flow: f32,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self { prediction: 1.0, pre: 0.2, perceptual: 0.0, flow: 0.0 }
    }
}

/// What a pass makes use of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LoopOptions {
    /// The sensor inside the loop.
    pub forward_model: bool,
    /// The previous estimate as an input.
    pub self_conditioning: bool,
}

impl LoopOptions {
    /// Everything.
    pub const ALL: Self = Self { forward_model: true, self_conditioning: true };
    /// Nothing: a first pass would be in vain.
    pub const NONE: Self = Self { forward_model: false, self_conditioning: false };
}

/// `mean (p - q)^2 + 0.01 (mean |across| + mean |down|)`, where across and down are differences of neighbours of
/// `p - q` along rows and columns. `p`, `q`: `[images, 1, height, width]` in [0, 1]; result `[1]`.
pub fn reconstruction(p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
    let error = p - q;
    let [_, _, height, width] = error.dims();
    let difference = |axis: usize, size: usize| {
        let part = |first| error.clone().narrow(axis, first, size - 1);
        (part(1) - part(0)).abs().mean()
    };
    let variation = difference(3, width) + difference(2, height);
    error.powi_scalar(2).mean() + variation * VARIATION
}

/// Bursts to learn from.
#[derive(Clone, Debug)]
pub struct Example<'a> {
    /// What was measured.
    pub measured: &'a Measured,
    /// The clean frames, `[bursts * frames, 1, height, width]` in [0, 1].
    pub truth: Tensor<4>,
    /// Sensor and light of every burst.
    pub acquisitions: &'a [Acquisition],
    /// Standard normal noise of the truth's shape.
    pub noise: Tensor<4>,
    /// Diffusion time of every burst.
    pub timesteps: &'a [usize],
}

/// Whether a first pass makes the estimate that the network is given, as at sampling after the first step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SelfConditioning {
    /// The network starts from nothing.
    Off,
    /// The network gets its own estimate from a noisier image, and that estimate measured again with photons
    /// of this seed.
    On(u64),
}

/// The terms of the loss, `[1]` each, unweighted but the total.
#[derive(Clone, Debug)]
pub struct LossTerms {
    /// The weighted sum.
    pub total: Tensor<1>,
    /// Of the prediction; about 1 where it knows no more than the deviations told of every pixel's error.
    pub prediction: Tensor<1>,
    /// Of the pre-denoised frames.
    pub pre: Tensor<1>,
    /// The perceptual distance of the prediction.
    pub perceptual: Option<Tensor<1>>,
    /// How far neighbours warped along the flows are from the truth; computed only where it has a weight.
    pub flow: Option<Tensor<1>>,
    /// How well the pre-denoiser knows its errors, if it tells them; its weight is 1, for nothing else learns from it.
    pub uncertainty: Option<Tensor<1>>,
}

/// A diffusion time to train at, from two uniform numbers in [0, 1): the share `start` of all where sampling begins, the
/// others by [`NoiseSchedule::time_at`].
pub fn training_timestep(kind: f64, place: f64, start: f64) -> usize {
    if kind < start {
        return TIMES - 1;
    }
    NoiseSchedule::cosine(TIMES).time_at(place)
}

/// The time of the estimate before `time`: a tenth of all further, by their roots.
fn previous_timestep(time: usize) -> usize {
    let times = TIMES as f64;
    let share = ((time + 1) as f64 / times).sqrt() + 0.1;
    ((times * share * share).round() as usize - 1).min(TIMES - 1)
}

/// The loss of `network`, which is on an autodiff device, on an example on the same device.
///
/// # Errors
/// [`SimError`] if the device fails or a sensor is impossible.
pub fn loss_terms(
    network: &Qudi,
    example: &Example<'_>,
    self_conditioning: SelfConditioning,
    weights: LossWeights,
    loop_options: LoopOptions,
    perceptual: Option<&Perceptual>,
) -> Result<LossTerms> {
    if weights.prediction == 0.0 && perceptual.is_none() {
        return Ok(first_stage_terms(network, example, weights));
    }
    let schedule = NoiseSchedule::cosine(TIMES);
    let clean = example.truth.clone() * 2.0 - 1.0;
    let noisy = |times: &[usize]| {
        let bursts = times.len();
        let [images, _, height, width] = clean.dims();
        let level = |f: fn(f64) -> f64| {
            let values: Vec<f32> =
                times.iter().map(|&t| f(schedule.alpha_bar(Some(t))) as f32).collect();
            let values = Tensor::<1>::from_floats(values.as_slice(), &clean.device());
            values.reshape([bursts, 1]).repeat_dim(1, images / bursts).reshape([images, 1, 1, 1])
        };
        let signal = level(f64::sqrt).expand([images, 1, height, width]);
        let noise = level(|a| (1.0 - a).sqrt()).expand([images, 1, height, width]);
        clean.clone() * signal + example.noise.clone() * noise
    };
    let (x0_prev, known, simulated) = match self_conditioning {
        // Where sampling begins, nothing comes before.
        SelfConditioning::On(seed) if example.timesteps.iter().any(|&t| t < TIMES - 1) => {
            let previous: Vec<usize> =
                example.timesteps.iter().map(|&t| previous_timestep(t)).collect();
            let x_t = noisy(&previous);
            let (x0_prev, simulated) = estimate(network, example, x_t, previous, seed)?;
            let known =
                simulated.exists.iter().map(|&exists| exists && loop_options.self_conditioning);
            (x0_prev, known.collect(), Some(simulated).filter(|_| loop_options.forward_model))
        }
        _ => (clean.zeros_like(), vec![false; example.timesteps.len()], None),
    };
    let state =
        State { x_t: noisy(example.timesteps), x0_prev, known, times: example.timesteps.to_vec() };
    let prepared = network.prepare(example.measured);
    let result = network.forward(&prepared, simulated.as_ref(), &state, None);
    let unknown = (result.x0.clone() - clean.clone()) / result.unit.clamp_min(LEAST_UNIT);
    let prediction = unknown.powi_scalar(2).mean();
    let image = (result.x0 + 1.0) * 0.5;
    // Statistics are differences of large numbers.
    let perceptual = perceptual.map(|term| {
        with_precision(ComputePrecision::F32, || term.loss(image, example.truth.clone()))
    });
    let pre = relative_reconstruction(example)(result.d);
    let mut total = prediction.clone() * weights.prediction + pre.clone() * weights.pre;
    if let Some(term) = &perceptual {
        total = total + term.clone() * weights.perceptual;
    }
    let frames = example.measured.frames;
    let flow = (weights.flow > 0.0).then(|| result.flows.misfit(example.truth.clone(), frames));
    if let Some(term) = &flow {
        total = total + term.clone() * weights.flow;
    }
    // Told, too, of frames before any simulated measurement.
    let uncertainty = network.tells_errors().then(|| network.denoise(&example.measured.guide));
    let uncertainty =
        uncertainty.and_then(|(d, deviation)| uncertainty_loss(example, &d, deviation));
    if let Some(term) = &uncertainty {
        total = total + term.clone();
    }
    Ok(LossTerms { total, prediction, pre, perceptual, flow, uncertainty })
}

/// The terms of pre-denoiser and flow alone, or of the pre-denoiser alone where the flow has no weight: a first stage, at
/// a fifth of the cost or less, for what must work before the rest can learn from it.
fn first_stage_terms(network: &Qudi, example: &Example<'_>, weights: LossWeights) -> LossTerms {
    let measured = example.measured;
    let (d, deviation, flows) = if weights.flow > 0.0 {
        let (d, flows) = network.denoise_and_align(&network.prepare(measured));
        let told = network.tells_errors().then(|| network.denoise(&measured.guide).1);
        (d, told.flatten(), Some(flows))
    } else {
        let (d, deviation) = network.denoise(&measured.guide);
        (d, deviation, None)
    };
    let uncertainty = uncertainty_loss(example, &d, deviation);
    let pre = relative_reconstruction(example)(d);
    let flow = flows.map(|flows| flows.misfit(example.truth.clone(), measured.frames));
    let mut total = pre.clone() * weights.pre;
    if let Some(term) = &flow {
        total = total + term.clone() * weights.flow;
    }
    if let Some(term) = &uncertainty {
        total = total + term.clone();
    }
    LossTerms { total, prediction: pre.zeros_like(), pre, perceptual: None, flow, uncertainty }
}

/// [`gaussian_nll`] at the errors of pre-denoised frames, from which no gradient goes into the frames.
fn uncertainty_loss(
    example: &Example<'_>,
    d: &Tensor<4>,
    deviation: Option<Tensor<4>>,
) -> Option<Tensor<1>> {
    deviation.map(|deviation| gaussian_nll(d.clone().detach() - example.truth.clone(), deviation))
}

/// Mean negative logarithm of the density of errors under a normal law of these deviations, but for a constant: least where
/// the deviations are those of the errors (Kendall and Gal 2017, eq. 5). Same shapes, result `[1]`.
pub fn gaussian_nll(error: Tensor<4>, deviation: Tensor<4>) -> Tensor<1> {
    let square = (error / deviation.clone()).powi_scalar(2);
    (square * 0.5 + deviation.log()).mean()
}

/// The network's own estimate, without gradient, and its simulated measurement. Bursts at the last time have
/// neither: there sampling starts.
fn estimate(
    network: &Qudi,
    example: &Example<'_>,
    x_t: Tensor<4>,
    previous: Vec<usize>,
    seed: u64,
) -> Result<(Tensor<4>, Simulated)> {
    let device = example.truth.device();
    let measured = Measured {
        u: example.measured.u.clone().inner(),
        guide: example.measured.guide.clone().inner(),
        sensor: example.measured.sensor.clone().inner(),
        frames: example.measured.frames,
    };
    let network = network.valid();
    let x_t = x_t.inner();
    let known = vec![false; previous.len()];
    let state = State { x0_prev: x_t.zeros_like(), x_t, known, times: previous };
    let prediction = network.forward(&network.prepare(&measured), None, &state, None);
    let [_, _, height, width] = example.truth.dims();
    let size = Size { height, width };
    let mut x0 = read(prediction.x0.clamp(-1.0, 1.0))?;
    if !x0.iter().all(|value| value.is_finite()) {
        return Err(SimError::request(
            "the network's first estimate is not finite: the last checkpoint is good",
            "self-conditioning",
            "lower train.lr or train.clip and go on from the checkpoint with --resume",
        ));
    }
    let burst = measured.frames * size.pixels();
    let mut planes = Planes { y: Vec::new(), u: Vec::new() };
    let exists: Vec<bool> = example.timesteps.iter().map(|&t| t < TIMES - 1).collect();
    for (number, (x0, acquisition)) in
        x0.chunks_exact_mut(burst).zip(example.acquisitions).enumerate()
    {
        if !exists[number] {
            x0.fill(0.0);
            planes.y.resize(planes.y.len() + burst, 0.0);
            planes.u.resize(planes.u.len() + burst, 0.0);
            continue;
        }
        let images: Vec<f32> = x0.iter().map(|x0| (x0 + 1.0) * 0.5).collect();
        let sensor = LoopSensor::at(acquisition, example.timesteps[number], TIMES);
        let first = (number * measured.frames) as u64;
        let more = sensor.measure(&images, size, first, seed)?;
        planes.y.extend(more.y);
        planes.u.extend(more.u);
    }
    let tensor = |values| to_tensor(values, size, &device);
    let simulated = Simulated { y: tensor(planes.y), u: tensor(planes.u), exists };
    Ok((tensor(x0), simulated))
}
