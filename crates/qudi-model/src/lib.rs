//! Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! In the order of the data: a [`measurement`] turns counts into planes; the [`network`], whose sizes are a
//! [`config`], predicts clean frames from them and from a noisy image; the [`sampler`] takes noise to a
//! picture along the noise [`schedule`], measuring every estimate again with the sensor ([`physics`]); the
//! [`restorer`] does so for whole windows, tile by tile. Weights are a [`checkpoint`]; training minimises the
//! [`objective`], of which a [`perceptual`] distance can be a part. The device a tensor lives on decides the
//! backend; this crate chooses none.
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
