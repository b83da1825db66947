//! Operations that Burn's flex backend lacks or does slowly, with their gradients.
//!
//! Every operation takes tensors of any device: on flex it is computed here, elsewhere composed of Burn's
//! own operations with the same result.
#![warn(missing_docs)]

mod backend;
pub mod conv;
#[cfg(feature = "flex")]
mod flex;
pub mod group_norm;
#[cfg(feature = "flex")]
mod uninitialised;
mod warp;

pub use backend::is_flex;
pub use warp::warp;
