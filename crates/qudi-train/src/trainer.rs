//! The network during training: its weights, their average, the optimizer's state.

mod loss_values;

use super::ema::Ema;
use super::learner::{Context, Learner, Loss};
use super::optimizer::{Optimizer, learning_rate};
use super::parameters::{parameters, with_frozen, with_parameters};
use super::prefetch::Prefetcher;
use super::recipe::Recipe;
use crate::loss::lpips::Lpips;
use burn::tensor::{Device, Tensor};
use qudi_core::{Error, Result, Size};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::tensor::read;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

pub use loss_values::LossValues;

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
}

/// The gradients and losses of one batch, and the seconds that they took.
struct Pass {
    gradients: Vec<Tensor<1>>,
    statistics: Vec<(usize, Tensor<1>)>,
    loss: LossValues,
    forward_s: f64,
    backward_s: f64,
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
        })
    }

    /// Returns the number of steps taken.
    pub fn step_number(&self) -> u64 {
        self.optimizer.steps
    }

    /// Returns the number of batches used.
    pub fn batches(&self) -> u64 {
        self.step_number() * self.recipe.train.accumulate as u64
    }

    /// Returns the network with averaged weights, for use.
    pub fn averaged(&self) -> L {
        with_parameters(self.network.valid(), self.ema.average.clone())
    }

    /// Takes one step.
    ///
    /// # Errors
    /// [`Error`] if the data or the device fails, or the loss is not finite.
    pub fn step(&mut self, prefetcher: &mut Prefetcher<L>) -> Result<StepReport> {
        let start = Instant::now();
        let count = self.recipe.train.accumulate;
        let batches = (0..count).map(|_| prefetcher.next_batch()).collect::<Result<Vec<_>>>()?;
        let data_s = start.elapsed().as_secs_f64();
        let passes = self.passes(&batches)?;
        let start = Instant::now();
        let mut sum: Option<Vec<Tensor<1>>> = None;
        let mut loss = LossValues::default();
        let (mut forward_s, mut backward_s) = (0.0, 0.0);
        let mut statistics: BTreeMap<usize, Tensor<1>> = BTreeMap::new();
        // Summed in the order of the batches: which device had them makes no difference.
        for pass in passes {
            loss.add(&pass.loss, 1.0 / count as f64);
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
        let norm = norm(&gradients)? / count as f64;
        self.check("gradient norm", norm)?;
        let train = &self.recipe.train;
        let taken = self.step_number();
        let lr = learning_rate(train, taken);
        let scale = (train.clip / (norm + 1e-12)).min(1.0) / count as f64;
        let mut moved = self.optimizer.step(parameters(&self.network), gradients, scale, lr);
        for (place, values) in statistics {
            moved[place] = values;
        }
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
    fn passes(&self, batches: &[L::Batch]) -> Result<Vec<Pass>> {
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
            pass
        };
        Ok(lists.into_iter().map(home).collect())
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
        let forward_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let Loss { total, terms, gradients, statistics } = loss;
        let gradients = with_precision(precision, gradients);
        // Reading waits for the device: all numbers at once, when there is nothing left to ask it for.
        let loss = LossValues::read(&total, &terms)?;
        for (name, value) in &loss.terms {
            self.check(&format!("{name} loss"), *value)?;
        }
        let backward_s = start.elapsed().as_secs_f64();
        Ok(Pass { gradients, statistics, loss, forward_s, backward_s })
    }

    fn check(&self, what: &str, value: f64) -> Result<()> {
        if value.is_finite() {
            return Ok(());
        }
        let step = self.step_number() + 1;
        let (found, help) = match self.saved {
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
}

fn unsupported(precision: ComputePrecision, device: &Device) -> Error {
    Error::request(
        format!("{device:?} cannot compute with {precision} numbers"),
        "train.precision",
        "set it to \"f32\", which all devices have",
    )
}

/// Computes the Euclidean norm over all lists.
fn norm(gradients: &[Tensor<1>]) -> Result<f64> {
    let squares = gradients.iter().map(|g| g.clone().powi_scalar(2).sum()).collect();
    let squares = read(Tensor::cat(squares, 0))?;
    Ok(squares.into_iter().map(f64::from).sum::<f64>().sqrt())
}
