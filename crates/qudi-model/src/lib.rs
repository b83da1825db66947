//! Quanta Diffusion on Burn: from photon counts to clean video.
//!
//! The network follows in the order of the data; so far there are its two ends: counts become
//! tensors ([`tensor`]), and the diffusion's noise follows a [`schedule`]. The device a tensor
//! lives on decides the backend; this crate chooses none.
#![warn(missing_docs)]

pub mod schedule;
pub mod tensor;
