//! The diffusion process: schedule, sampler, noise, preconditioning and the sensor in the loop.

pub mod noise;
pub mod physics;
pub(crate) mod precondition;
pub mod sampler;
pub mod schedule;
