//! Training of networks: data, loss, loop, state, validation.
//!
//! A [`Recipe`] holds everything that decides the result, and a [`Learner`] is a network that it can be for.
//! A [`Prefetcher`] draws batches on threads of its own, the [`Trainer`] takes a step with each, and a
//! [`Run`] does so in a folder from which it can be resumed.

#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;

mod burst_cache;
pub mod dataset;
mod digest;
mod ema;
mod learner;
pub mod loss;
mod optimizer;
mod parameters;
mod prefetch;
mod recipe;
mod run;
pub mod selftest;
mod speed;
mod state;
mod trainer;
mod validate;

pub use burst_cache::{BurstSampler, Files, draw_bursts};
pub use learner::{AlignedBatch, Context, CountBatch, Learner, Loss, Origin, diffusion};
pub use optimizer::{Optimizer, OptimizerKind, learning_rate};
pub use parameters::{gradients, parameters, with_parameters};
pub use prefetch::{Prefetcher, default_workers};
pub use recipe::{
    CropsConfig, LearningPart, LossConfig, NetworkRecipe, Recipe, StageConfig, TrainConfig,
    ValidationConfig, recipe_names, recipe_table,
};
pub use run::{Event, From, METRICS, RECIPE, Run, WEIGHTS};
pub use speed::TrainingSpeed;
pub use state::{remove_state, run_exists, steps_taken};
pub use trainer::{LossValues, StepReport, Trainer};
pub use validate::{Validation, ValidationClip, Validator};
