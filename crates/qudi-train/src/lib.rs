//! Learning the network from photons: data, loop, state, validation.
//!
//! A [`Recipe`] says everything that decides the result. A [`Prefetcher`] draws batches on threads of its own; the
//! [`Trainer`] learns from them, step by step; a [`Run`] does so in a folder that a killed run goes on from.

#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;

mod batch;
mod burst;
mod burst_cache;
mod burst_sampler;
pub mod dataset;
mod draw_bursts;
mod ema;
mod learning_rate;
pub mod loss;
mod optimizer;
mod parameters;
mod prefetch;
mod recipe;
mod run;
pub mod selftest;
mod state;
mod trainer;
mod validate;

pub use batch::Batch;
pub use burst_sampler::BurstSampler;
pub use draw_bursts::draw_bursts;
pub use learning_rate::learning_rate;
pub use optimizer::Adam;
pub use parameters::{gradients, parameters, with_parameters};
pub use prefetch::Prefetcher;
pub use recipe::{CropsConfig, LossConfig, Recipe, TrainConfig, ValidationConfig};
pub use run::{Event, Files, From, METRICS, RECIPE, Run, WEIGHTS};
pub use trainer::{LossValues, StepReport, Trainer};
pub use validate::{Validation, ValidationClip, Validator};
