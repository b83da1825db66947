//! Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! In the order of the data: [`conditioning`] turns counts and reference estimate into named planes. The
//! [`network`], whose sizes are a [`config`], predicts clean frames from them and from a noisy image.
//! [`refinement`] aligns a window again on what its first pre-denoisers restore. [`diffusion`] holds the
//! noise schedule, the sampler and the sensor's forward model. The [`restorer`] restores whole windows, tile
//! by tile, by regression or by diffusion. Weights are a [`checkpoint`]. The device of a tensor decides the
//! backend; this crate chooses none.
#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;
pub mod checkpoint;
pub mod conditioning;
pub mod config;
mod cost;
pub mod diffusion;
pub mod network;
pub mod refinement;
pub mod restorer;

pub use qudi_kernels::{ComputePrecision, MatrixUnits, MatrixUnitsError, with_precision};
