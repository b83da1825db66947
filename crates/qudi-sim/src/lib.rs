//! Scenes to counts: scenes and clips, exposed by a simulated camera.
//!
//! A [`clip::Input`] yields frames in [0, 1]; [`simulate`] exposes them with a
//! [`Camera`](qudi_core::Camera) and passes the counts to a [`Sink`].
#![warn(missing_docs)]

pub mod clip;
pub mod scene;
mod simulate;

pub use simulate::{Exposed, Progress, Simulation, Sink, Stage, Start, Summary, simulate};
