//! The diffusion process: schedule, timesteps, sampler, noise, preconditioning and the sensor's forward
//! model.

pub mod forward_model;
pub mod noise;
pub(crate) mod precondition;
pub mod sampler;
pub mod schedule;
pub mod state;
pub mod timesteps;
