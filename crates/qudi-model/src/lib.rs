//! Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! In the order of the data: [`measurement`] turns counts into planes. The [`network`], whose sizes are a
//! [`config`], predicts clean frames from them and from a noisy image. [`diffusion`] holds the noise schedule, the
//! sampler and the sensor's forward model. The [`restorer`] restores whole windows, tile by tile. Weights are a
//! [`checkpoint`]. The device of a tensor decides the backend; this crate chooses none.
#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;
pub mod checkpoint;
pub mod config;
mod cost;
pub mod diffusion;
pub mod draft;
pub mod measurement;
pub mod network;
pub mod restorer;
pub mod tensor;

pub use qudi_kernels::{ComputePrecision, with_precision};
