//! The network during training: its weights, their average, the optimizer's state.

mod dead_layers;
mod loss_values;
mod parts;

use super::ema::Ema;
use super::learner::{Context, Learner, Loss};
use super::optimizer::{Optimizer, learning_rate};
use super::parameters::{parameters, with_frozen, with_parameters};
use super::prefetch::Prefetcher;
use super::recipe::Recipe;
use crate::loss::lpips::Lpips;
use burn::tensor::{Device, Tensor};
use qudi_core::{Error, Result, Size};
use qudi_kernels::{ComputePrecision, is_flex, with_precision};
use qudi_layers::tensor::read;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

pub use loss_values::LossValues;
use loss_values::UnreadLoss;
use parts::{PARTS, Workers};

/// The result of a step.
#[derive(Clone, Debug, PartialEq, Serialize)]
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
pub struct Trainer<L> {
    recipe: Recipe,
    /// Devices with autodiff; the first one holds weights and optimizer.
    devices: Vec<Device>,
    pub(super) network: L,
    pub(super) ema: Ema,
    pub(super) optimizer: Optimizer,
    /// Steps of the last state that was written or read.
    pub(super) saved: Option<u64>,
    perceptual: Vec<Lpips>,
    /// Whether each parameter learns.
    learns: Vec<bool>,
    unread: Option<Unread>,
    /// Threads for the parts of batches on the processor.
    workers: Workers,
    /// True if each part of a step waits for the device, so that its time is the device's.
    pub(super) waits: bool,
}

/// The gradients and losses of one batch, and the seconds that they took.
struct Pass {
    gradients: Vec<Tensor<1>>,
    statistics: Vec<(usize, Tensor<1>)>,
    loss: UnreadLoss,
    forward_s: f64,
    backward_s: f64,
}

/// A step whose numbers are still on the device.
#[derive(Debug)]
struct Unread {
    losses: Vec<UnreadLoss>,
    norm: Tensor<1>,
    /// The report but for loss and norm.
    report: StepReport,
}

impl<L: Learner> Trainer<L> {
    /// Starts from `network`, or from the recipe's initial weights. `devices` are without autodiff; batches
    /// go to them in turn. `backbones` is the folder of the perceptual term's weights.
    ///
    /// # Errors
    /// [`Error`] if the recipe is for another network, the perceptual term cannot be loaded, or a device
    /// lacks the numbers of `train.precision`.
    pub fn new(
        recipe: &Recipe,
        network: Option<L>,
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
        let mut learner = L::init(recipe, main)?;
        if let Some(network) = network {
            learner = with_parameters(learner, parameters(&network));
        }
        let learns = learner.learns(recipe);
        learner = with_frozen(learner, &learns);
        let start = parameters(&learner);
        let shapes = learner.named_shapes();
        let shapes = shapes.iter().map(|(name, shape)| (name.as_str(), shape.as_slice()));
        let (_, side) = recipe.sample_size();
        let mut perceptual = Vec::new();
        for device in &devices {
            if let Some(lpips) = Lpips::load(recipe.train.loss().term, backbones, device)? {
                lpips.check(Size { height: side, width: side })?;
                perceptual.push(lpips);
            }
        }
        Ok(Self {
            recipe: recipe.clone(),
            optimizer: Optimizer::new(recipe.train.optimizer, &start, shapes, L::prefers_adam),
            ema: Ema::new(start, recipe.train.ema),
            saved: None,
            network: learner,
            devices,
            perceptual,
            learns,
            unread: None,
            workers: Workers::default(),
            waits: false,
        })
    }

    /// Returns the number of steps taken.
    pub fn step_number(&self) -> u64 {
        self.optimizer.steps
    }

    /// Returns the names of the layers that no gradient reaches any more, though others of their part learn.
    /// None before the tenth step.
    ///
    /// # Errors
    /// [`Error`] if the device fails.
    pub fn dead_layers(&self) -> Result<Vec<String>> {
        if self.step_number() < dead_layers::FIRST_STEPS {
            return Ok(Vec::new());
        }
        let names: Vec<String> =
            self.network.named_shapes().into_iter().map(|(name, _)| name).collect();
        let idle = L::idle_layers(&self.recipe);
        let is_idle =
            |name: &str| idle.iter().any(|layer| name.trim_end_matches(".weight") == *layer);
        let learns: Vec<bool> = names
            .iter()
            .zip(&self.learns)
            .map(|(name, learns)| *learns && !is_idle(name))
            .collect();
        dead_layers::dead_layers(&names, &self.optimizer.mean, &learns)
    }

    /// Returns the number of batches used.
    pub fn batches(&self) -> u64 {
        self.step_number() * self.recipe.train.accumulate as u64
    }

    /// Returns the device if it is a single one with memory of its own.
    pub(super) fn card(&self) -> Option<Device> {
        let [device] = self.devices.as_slice() else { return None };
        (!is_flex(device)).then(|| device.clone())
    }

    /// Returns the network with averaged weights, for use.
    pub fn averaged(&self) -> L {
        with_parameters(self.network.valid(), self.ema.average.clone())
    }

    /// Takes one step, and waits for its numbers.
    ///
    /// # Errors
    /// [`Error`] if the data or the device fails, or the loss is not finite.
    pub fn step(&mut self, prefetcher: &mut Prefetcher<L>) -> Result<StepReport> {
        self.finish()?;
        self.begin_step(prefetcher)?;
        Ok(self.finish()?.expect("a step has begun"))
    }

    /// Asks the device for one step, and returns the report of the step before, if that is not out yet. A
    /// graphics card never waits for the processor: numbers are read when the next step is asked for.
    ///
    /// # Errors
    /// [`Error`] if the data or the device fails, or the loss of the step before was not finite.
    pub fn begin_step(&mut self, prefetcher: &mut Prefetcher<L>) -> Result<Option<StepReport>> {
        let start = Instant::now();
        let batches = 0..self.recipe.train.accumulate;
        let batches = batches.map(|_| prefetcher.next_batch()).collect::<Result<Vec<_>>>()?;
        let data_s = start.elapsed().as_secs_f64();
        let passes = self.passes(batches)?;
        let count = passes.len();
        let start = Instant::now();
        let mut sum: Option<Vec<Tensor<1>>> = None;
        let mut losses = Vec::with_capacity(count);
        let (mut forward_s, mut backward_s) = (0.0, 0.0);
        let mut statistics: BTreeMap<usize, Tensor<1>> = BTreeMap::new();
        // Summed in the order of the batches: which device had them makes no difference.
        for pass in passes {
            losses.push(pass.loss);
            // All batches of a step start from the same statistics: what they make of them is averaged.
            for (place, values) in pass.statistics {
                let share = values / count as f32;
                let sum = statistics.remove(&place).map_or(share.clone(), |sum| sum + share);
                statistics.insert(place, sum);
            }
            forward_s += pass.forward_s;
            backward_s += pass.backward_s;
            sum = Some(match sum {
                None => pass.gradients,
                Some(sum) => sum.into_iter().zip(pass.gradients).map(|(a, b)| a + b).collect(),
            });
        }
        let gradients = sum.expect("at least one batch");
        let norm = norm(&gradients) / count as f64;
        let train = &self.recipe.train;
        let taken = self.step_number();
        let lr = learning_rate(train, taken);
        let scale = (norm.clone() + 1e-12).recip() * train.clip;
        let scale = scale.clamp_max(1.0) / count as f64;
        let mut moved = self.optimizer.step(parameters(&self.network), &gradients, &scale, lr);
        for (place, values) in statistics {
            moved[place] = values;
        }
        self.ema.update(&moved, &self.learns, taken);
        self.network = with_parameters(self.network.clone(), moved);
        let before = self.finish()?;
        self.wait(0)?;
        let report = StepReport {
            step: self.step_number(),
            lr,
            loss: LossValues::default(),
            norm: 0.0,
            data_s,
            forward_s,
            backward_s,
            optimizer_s: start.elapsed().as_secs_f64(),
        };
        self.unread = Some(Unread { losses, norm, report });
        Ok(before)
    }

    /// Waits for the step that was asked for last, and returns its report, if that is not out yet.
    ///
    /// # Errors
    /// [`Error`] if the device fails, or the loss is not finite.
    pub fn finish(&mut self) -> Result<Option<StepReport>> {
        let Some(Unread { losses, norm, mut report }) = self.unread.take() else {
            return Ok(None);
        };
        let numbers = losses.iter().map(|loss| loss.numbers.clone()).chain([norm]);
        let numbers = read(Tensor::cat(numbers.collect(), 0))?;
        let (norm, numbers) = numbers.split_last().expect("a norm");
        let mut numbers = numbers.iter().copied().map(f64::from);
        let losses: Vec<_> = losses.iter().map(|loss| loss.values(&mut numbers)).collect();
        for (name, value) in losses.iter().flat_map(|loss| &loss.terms) {
            check(&format!("{name} loss"), *value, report.step, self.saved)?;
        }
        report.loss = LossValues::mean(&losses);
        report.norm = f64::from(*norm);
        check("gradient norm", report.norm, report.step, self.saved)?;
        Ok(Some(report))
    }

    /// Computes the gradients of all batches, or of equal parts of them, in their order, on the first device.
    fn passes(&self, batches: Vec<L::Batch>) -> Result<Vec<Pass>> {
        let main = self.devices[0].clone().inner();
        if self.devices.len() == 1 {
            let whole = batches.len();
            // Several parts on the processor, the same on any number of threads.
            let parts = if is_flex(&main) { PARTS } else { 1 };
            let batches = batches.into_iter().flat_map(|batch| L::parts(batch, parts));
            let batches: Vec<_> = batches.collect();
            if batches.len() > whole {
                return self.parallel_passes(&batches);
            }
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
                    let network = with_parameters(L::uninitialized(&self.recipe, device)?, weights);
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
            let statistics = pass.statistics.into_iter();
            pass.statistics = statistics.map(|(at, s)| (at, s.to_device(&main))).collect();
            pass.loss.numbers = pass.loss.numbers.to_device(&main);
            pass
        };
        Ok(lists.into_iter().map(home).collect())
    }

    /// Waits for device `number`, if parts of a step are to be timed.
    fn wait(&self, number: usize) -> Result<()> {
        if !self.waits {
            return Ok(());
        }
        self.devices[number].sync().map_err(|e| {
            Error::request(format!("the device failed: {e:?}"), "device", "choose another device")
        })
    }

    /// Passes one batch through `network`, on device `number`.
    fn pass(&self, network: &L, batch: &L::Batch, number: usize) -> Result<Pass> {
        let start = Instant::now();
        let precision = self.recipe.train.precision;
        let context = Context {
            recipe: &self.recipe,
            device: &self.devices[number],
            step: self.step_number(),
            perceptual: self.perceptual.get(number),
        };
        let loss = with_precision(precision, || network.loss(batch, &context))?;
        self.wait(number)?;
        let forward_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let Loss { total, terms, gradients, statistics } = loss;
        let gradients = with_precision(precision, gradients);
        let loss = UnreadLoss::new(&total, &terms);
        self.wait(number)?;
        let backward_s = start.elapsed().as_secs_f64();
        Ok(Pass { gradients, statistics, loss, forward_s, backward_s })
    }
}

/// Checks a number of step `step`; `saved` is the step of the last checkpoint.
fn check(what: &str, value: f64, step: u64, saved: Option<u64>) -> Result<()> {
    if value.is_finite() {
        return Ok(());
    }
    let (found, help) = match saved {
        Some(saved) => (
            format!("the checkpoint of step {saved} is good"),
            "lower train.lr or train.clip, and resume from the checkpoint",
        ),
        None => (
            "there is no checkpoint yet".to_owned(),
            "lower train.lr or train.clip, and start again",
        ),
    };
    Err(Error::request(
        format!("{what} is {value} at step {step}: training stopped, {found}"),
        what,
        help,
    ))
}

fn unsupported(precision: ComputePrecision, device: &Device) -> Error {
    Error::request(
        format!("{device:?} cannot compute with {precision} numbers"),
        "train.precision",
        "set it to \"f32\", which all devices have",
    )
}

/// Computes the Euclidean norm over all lists, `[1]`.
fn norm(gradients: &[Tensor<1>]) -> Tensor<1> {
    if is_flex(&gradients[0].device()) {
        let squares = gradients.par_iter().map(|list| list.clone().powi_scalar(2).sum());
        return Tensor::cat(squares.collect(), 0).sum().sqrt();
    }
    Tensor::cat(gradients.to_vec(), 0).powi_scalar(2).sum().sqrt()
}
