//! The two networks of Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! [`regression`] aligns a window on a reference estimate and corrects it frame by frame: the default method.
//! [`diffusion`] is the paper's system, which samples from photons alone. They share what describes counts
//! ([`counts`]) and sensors ([`sensor`]), and the format of weights ([`checkpoint`]), which name their kind
//! ([`config`]). [`colour`] corrects colours behind a filter. The device of a tensor decides the backend;
//! this crate chooses none.
#![warn(missing_docs)]

pub mod aligned;
#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;
pub mod checkpoint;
pub mod colour;
pub mod config;
pub mod counts;
pub mod diffusion;
#[cfg(test)]
mod golden_tests;
mod initial;
pub mod regression;
mod residual_dense;
pub mod restorer;
pub mod sensor;
pub mod window;

pub use qudi_kernels::{ComputePrecision, MatrixUnits, MatrixUnitsError, with_precision};
pub use qudi_layers::{init_parameters, parameter_shapes};
