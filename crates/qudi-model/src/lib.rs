//! Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! In the order of the data: counts become tensors ([`tensor`]); the [`network`], whose sizes are a
//! [`config`], predicts clean frames from them and from a noisy image. The device a tensor lives on decides
//! the backend; this crate chooses none.
#![warn(missing_docs)]

pub mod config;
mod error;
pub mod network;
pub mod objective;
pub mod schedule;
pub mod tensor;

pub use error::{ModelError, Result};
