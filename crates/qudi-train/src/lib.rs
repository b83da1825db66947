//! Learning the network from photons: data, loop, state, validation.
//!
//! A [`Recipe`] says everything that decides the result. A [`Feed`] draws batches on threads of its own; the
//! [`Trainer`] learns from them, step by step; a [`Run`] does so in a folder that a killed run goes on from.

#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;

mod adam;
mod batch;
mod bursts;
pub mod dataset;
mod draw;
mod feed;
mod kept;
mod learning_rate;
pub mod objective;
pub mod perceptual;
mod recipe;
mod run;
pub mod selftest;
mod state;
mod trainer;
mod validate;
mod values;

pub use adam::Adam;
pub use batch::Batch;
pub use bursts::Bursts;
pub use draw::draw_bursts;
pub use feed::Feed;
pub use learning_rate::learning_rate;
pub use recipe::{LossConfig, PartsConfig, Recipe, TrainConfig, ValidationConfig};
pub use run::{Event, Files, From, METRICS, RECIPE, Run, WEIGHTS};
pub use trainer::{Losses, StepReport, Trainer};
pub use validate::{Validation, ValidationClip, Validator};
pub use values::{gradients, values, with_values};
