//! The network during training: its weights, their average, the optimizer's state.

use super::batch::Batch;
use super::ema::Ema;
use super::optimizer::{Adam, learning_rate};
use super::parameters::{parameters, with_frozen, with_parameters};
use super::prefetch::Prefetcher;
use super::recipe::{LearningPart, LossConfig, Recipe};
use crate::loss::lpips::Lpips;
use crate::loss::{LoopOptions, LossTerms, LossWeights, NoiseOn, SelfConditioning, loss_terms};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_core::{Error, Result, Size};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_model::checkpoint::ModelKind;
use qudi_model::config::Part;
use qudi_model::network::{Qudi, parameter_shapes};
use qudi_model::tensor::read;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// The terms of the loss, each the mean over a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct LossValues {
    /// The weighted sum.
    pub total: f64,
    /// The term of the prediction.
    pub prediction: f64,
    /// The term of the pre-denoised frames.
    pub pre: f64,
    /// The perceptual term.
    pub perceptual: f64,
    /// The term of the flows.
    pub flow: f64,
    /// The term of the predicted uncertainty.
    #[serde(rename = "error")]
    pub uncertainty: f64,
}

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StepReport {
    /// The number of steps taken, this one included.
    pub step: u64,
    /// The learning rate.
    #[serde(rename = "rate")]
    pub lr: f64,
    /// The loss.
    #[serde(flatten)]
    pub loss: LossValues,
    /// The norm of the gradient before clipping.
    pub norm: f64,
    /// Seconds that the step waited for data.
    pub data_s: f64,
    /// Seconds of the forward passes; on devices that compute on their own, of asking for them.
    pub forward_s: f64,
    /// Seconds of the backward passes.
    pub backward_s: f64,
    /// Seconds of the optimizer.
    pub optimizer_s: f64,
}

/// Trains a network step by step on one or more devices.
#[derive(Debug)]
pub struct Trainer {
    recipe: Recipe,
    /// Devices with autodiff; the first one holds weights and optimizer.
    devices: Vec<Device>,
    pub(super) network: Qudi,
    pub(super) ema: Ema,
    pub(super) adam: Adam,
    perceptual: Vec<Lpips>,
    /// Whether each parameter learns.
    learns: Vec<bool>,
    /// Whether frames are pre-denoised once for all passes ([`LoopOptions::pre_is_fixed`]).
    pub(super) pre_is_fixed: bool,
}

/// The gradients and losses of one batch, and the seconds that they took.
struct Pass {
    gradients: Vec<Tensor<1>>,
    loss: LossValues,
    forward_s: f64,
    backward_s: f64,
}

impl Trainer {
    /// Starts from `network`, or from the recipe's initial weights. `devices` are without autodiff; batches
    /// go to them in turn. `backbones` is the folder of the perceptual term's weights.
    ///
    /// # Errors
    /// [`Error`] if the perceptual term cannot be loaded, or a device lacks the numbers of `train.precision`.
    pub fn new(
        recipe: &Recipe,
        network: Option<Qudi>,
        devices: &[Device],
        backbones: Option<&Path>,
    ) -> Result<Self> {
        let devices: Vec<Device> = devices.iter().map(|device| device.clone().autodiff()).collect();
        let Some(main) = devices.first() else {
            return Err(Error::request("no device", "devices", "name at least one"));
        };
        let precision = recipe.train.precision;
        if let Some(device) = devices.iter().find(|device| !precision.is_supported(device)) {
            return Err(unsupported(precision, device));
        }
        let mut learner = recipe.network.init(recipe.train.seed, main);
        if let Some(network) = network {
            learner = with_parameters(learner, parameters(&network));
        }
        let learns = learning(&learner, &recipe.train.learns);
        let pre_is_fixed = is_pre_fixed(&learner, &recipe.train.learns)?;
        learner = with_frozen(learner, &learns);
        let start = parameters(&learner);
        let (_, side) = recipe.sample_size();
        let mut perceptual = Vec::new();
        for device in &devices {
            if let Some(lpips) = Lpips::load(recipe.train.loss.term, backbones, device)? {
                lpips.check(Size { height: side, width: side })?;
                perceptual.push(lpips);
            }
        }
        Ok(Self {
            recipe: recipe.clone(),
            adam: Adam::new(&start),
            ema: Ema::new(start, recipe.train.ema),
            network: learner,
            devices,
            perceptual,
            learns,
            pre_is_fixed,
        })
    }

    /// The number of steps taken.
    pub fn step_number(&self) -> u64 {
        self.adam.steps
    }

    /// The number of batches used.
    pub fn batches(&self) -> u64 {
        self.step_number() * self.recipe.train.accumulate as u64
    }

    /// The network with averaged weights, for use.
    pub fn averaged(&self) -> Qudi {
        with_parameters(self.network.valid(), self.ema.average.clone())
    }

    /// Takes one step.
    ///
    /// # Errors
    /// [`Error`] if the data or the device fails, or the loss is not finite.
    pub fn step(&mut self, prefetcher: &mut Prefetcher) -> Result<StepReport> {
        let start = Instant::now();
        let count = self.recipe.train.accumulate;
        let batches = (0..count).map(|_| prefetcher.next_batch()).collect::<Result<Vec<_>>>()?;
        let data_s = start.elapsed().as_secs_f64();
        let passes = self.passes(&batches)?;
        let start = Instant::now();
        let mut sum: Option<Vec<Tensor<1>>> = None;
        let mut loss = LossValues::default();
        let (mut forward_s, mut backward_s) = (0.0, 0.0);
        // Summed in the order of the batches: which device had them makes no difference.
        for pass in passes {
            loss.add(pass.loss, 1.0 / count as f64);
            forward_s += pass.forward_s;
            backward_s += pass.backward_s;
            sum = Some(match sum {
                None => pass.gradients,
                Some(sum) => sum.into_iter().zip(pass.gradients).map(|(a, b)| a + b).collect(),
            });
        }
        let gradients = sum.expect("at least one batch");
        let norm = norm(&gradients)? / count as f64;
        self.check("gradient norm", norm)?;
        let train = &self.recipe.train;
        let taken = self.step_number();
        let lr = learning_rate(train, taken);
        let scale = (train.clip / (norm + 1e-12)).min(1.0) / count as f64;
        let moved = self.adam.step(parameters(&self.network), gradients, scale, lr);
        self.ema.update(&moved, &self.learns, taken);
        self.network = with_parameters(self.network.clone(), moved);
        let optimizer_s = start.elapsed().as_secs_f64();
        Ok(StepReport {
            step: self.step_number(),
            lr,
            loss,
            norm,
            data_s,
            forward_s,
            backward_s,
            optimizer_s,
        })
    }

    /// Computes the gradients of all batches, in their order, on the first device.
    fn passes(&self, batches: &[Batch]) -> Result<Vec<Pass>> {
        let main = self.devices[0].clone().inner();
        if self.devices.len() == 1 {
            return batches.iter().map(|batch| self.pass(&self.network, batch, 0)).collect();
        }
        let weights = parameters(&self.network);
        let lists = std::thread::scope(|scope| {
            let work = |number: usize| {
                let (weights, device) = (weights.clone(), &self.devices[number]);
                let mine = batches.iter().enumerate().skip(number).step_by(self.devices.len());
                move || -> Result<Vec<(usize, Pass)>> {
                    let inner = device.clone().inner();
                    let weights = weights.into_iter().map(|w| w.to_device(&inner)).collect();
                    let network =
                        with_parameters(self.recipe.network.uninitialized(device), weights);
                    let network = with_frozen(network, &self.learns);
                    mine.map(|(at, batch)| Ok((at, self.pass(&network, batch, number)?))).collect()
                }
            };
            let handles: Vec<_> =
                (0..self.devices.len()).map(|number| scope.spawn(work(number))).collect();
            let failed =
                || Err(Error::request("a device's thread failed", "devices", "report this"));
            let lists =
                handles.into_iter().map(|handle| handle.join().unwrap_or_else(|_| failed()));
            lists.collect::<Result<Vec<_>>>()
        })?;
        let mut lists: Vec<(usize, Pass)> = lists.into_iter().flatten().collect();
        lists.sort_by_key(|(at, _)| *at);
        let home = |(_, mut pass): (usize, Pass)| {
            pass.gradients = pass.gradients.into_iter().map(|g| g.to_device(&main)).collect();
            pass
        };
        Ok(lists.into_iter().map(home).collect())
    }

    /// Passes one batch through `network`, on device `number`.
    fn pass(&self, network: &Qudi, batch: &Batch, number: usize) -> Result<Pass> {
        let start = Instant::now();
        let device = &self.devices[number];
        let conditioning = batch.conditioning(device);
        let mut random = ChaCha8Rng::seed_from_u64(self.recipe.train.seed);
        random.set_stream(batch.number);
        let (weights, loop_options) = self.options();
        // Half of all batches start from nothing, as sampling does; but for its second step.
        let from_nothing = random.next_u64() & 1 == 0 && loop_options.noise_on == NoiseOn::Truth;
        let self_conditioning = if from_nothing || loop_options.needs_no_estimate() {
            SelfConditioning::Off
        } else {
            SelfConditioning::On(random.next_u64())
        };
        let example = batch.example(&conditioning);
        let perceptual = self.perceptual.get(number);
        let precision = self.recipe.train.precision;
        let terms = with_precision(precision, || {
            loss_terms(network, &example, self_conditioning, weights, loop_options, perceptual)
        })?;
        let forward_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let gradients = with_precision(precision, || terms.gradients(network, &conditioning));
        // Reading waits for the device: all numbers at once, when there is nothing left to ask it for.
        let loss = LossValues::read(terms)?;
        self.check("prediction loss", loss.prediction)?;
        self.check("pre-denoiser loss", loss.pre)?;
        self.check("perceptual loss", loss.perceptual)?;
        self.check("flow loss", loss.flow)?;
        self.check("uncertainty loss", loss.uncertainty)?;
        let backward_s = start.elapsed().as_secs_f64();
        Ok(Pass { gradients, loss, forward_s, backward_s })
    }

    fn options(&self) -> (LossWeights, LoopOptions) {
        let LossConfig { form, prediction, pre, perceptual, flow, .. } = self.recipe.train.loss;
        let network = &self.recipe.network;
        // Where nothing moves, there is nothing to learn of it.
        let flow = if network.ablates(Part::Flow) { 0.0 } else { flow };
        let loop_options = LoopOptions {
            forward_model: !network.ablates(Part::ForwardModel),
            self_conditioning: !network.ablates(Part::SelfConditioning),
            recomputes: self.recipe.train.gradient_checkpointing,
            pre_is_fixed: self.pre_is_fixed,
            noise_on: self.recipe.train.noise_on,
        };
        (LossWeights { form, prediction, pre, perceptual, flow }, loop_options)
    }

    fn check(&self, what: &str, value: f64) -> Result<()> {
        if value.is_finite() {
            return Ok(());
        }
        Err(Error::request(
            format!(
                "{what} is {value} at step {}: training stopped, the last checkpoint is good",
                self.step_number() + 1
            ),
            what,
            "lower train.lr or train.clip, and resume from the checkpoint",
        ))
    }
}

/// Whether each parameter of a network learns. Refinement stages never do.
fn learning(network: &Qudi, parts: &[LearningPart]) -> Vec<bool> {
    let learns = |name: &str| {
        let chosen = parts.is_empty() || parts.iter().any(|part| part.has(name));
        chosen && !name.starts_with("stages.")
    };
    parameter_shapes(network).iter().map(|(name, _)| learns(name)).collect()
}

/// Whether pre-denoised frames are the same in all passes: neither they nor their uncertainty learn, and they depend on
/// no simulated measurement.
pub(super) fn is_pre_fixed(network: &Qudi, parts: &[LearningPart]) -> Result<bool> {
    let learns = |part| parts.is_empty() || parts.contains(&part);
    if learns(LearningPart::Pre) || learns(LearningPart::Uncertainty) {
        return Ok(false);
    }
    Ok(ModelKind::of(network)? != ModelKind::Diffusion)
}

impl LossValues {
    /// Reads the terms from the device; those that are not there are zero.
    fn read(terms: LossTerms) -> Result<Self> {
        let LossTerms { total, prediction, pre, perceptual, flow, uncertainty, .. } = terms;
        let nothing = pre.zeros_like();
        let optional = |term: Option<Tensor<1>>| term.unwrap_or_else(|| nothing.clone());
        let optional = [perceptual, flow, uncertainty].map(optional);
        let all = Tensor::cat([total, prediction, pre].into_iter().chain(optional).collect(), 0);
        let numbers = read(all.inner())?;
        let number = |at: usize| f64::from(numbers[at]);
        Ok(Self {
            total: number(0),
            prediction: number(1),
            pre: number(2),
            perceptual: number(3),
            flow: number(4),
            uncertainty: number(5),
        })
    }

    fn add(&mut self, other: Self, share: f64) {
        self.total += share * other.total;
        self.prediction += share * other.prediction;
        self.pre += share * other.pre;
        self.perceptual += share * other.perceptual;
        self.flow += share * other.flow;
        self.uncertainty += share * other.uncertainty;
    }
}

fn unsupported(precision: ComputePrecision, device: &Device) -> Error {
    Error::request(
        format!("{device:?} cannot compute with {precision} numbers"),
        "train.precision",
        "set it to \"f32\", which all devices have",
    )
}

/// The Euclidean norm over all lists.
fn norm(gradients: &[Tensor<1>]) -> Result<f64> {
    let squares = gradients.iter().map(|g| g.clone().powi_scalar(2).sum()).collect();
    let squares = read(Tensor::cat(squares, 0))?;
    Ok(squares.into_iter().map(f64::from).sum::<f64>().sqrt())
}
