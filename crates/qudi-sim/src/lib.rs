//! Scenes to counts: scenes and clips, exposed by a simulated camera.
//!
//! A [`clip::Input`] says what to read and yields frames in [0, 1]; [`simulate`] sees it through a
//! [`Camera`](qudi_core::Camera) and hands counts to a [`Sink`].
#![warn(missing_docs)]

pub mod clip;
pub mod scene;
mod simulate;

pub use simulate::{Exposed, Progress, Simulation, Sink, Stage, Start, Summary, simulate};
