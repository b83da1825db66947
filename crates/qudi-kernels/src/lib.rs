//! Operations that Burn's flex backend lacks or computes slowly, with their gradients where learning needs
//! them.
//!
//! Every operation takes tensors of any device. On flex it is computed here, on LibTorch most are
//! LibTorch's own; elsewhere it is composed of Burn's own operations with the same result.
#![warn(missing_docs)]
// Vector code must be inlined into the functions that are compiled for the machine's vector unit.
#![allow(clippy::inline_always)]
// LibTorch is deprecated upstream, where no other backend trains as fast yet.
#![cfg_attr(feature = "libtorch", allow(deprecated))]

mod attention;
mod backend;
mod block_differences;
pub mod conv;
#[cfg(feature = "flex")]
mod exp;
#[cfg(feature = "flex")]
mod flex;
mod frames;
pub mod group_norm;
#[cfg(feature = "libtorch")]
mod libtorch;
mod matrix_units;
mod merge;
mod operations;
mod pixel_norm;
mod precision;
mod resample;
mod residual_stack;
mod tv_flow;
#[cfg(feature = "flex")]
mod uninitialised;
mod warp;

pub use attention::attention;
pub use backend::{is_flex, with_stock_operations};
pub use block_differences::block_differences;
pub use frames::frames;
#[cfg(feature = "libtorch")]
pub use libtorch::count_libtorch_cards;
pub use matrix_units::{MatrixUnits, MatrixUnitsError, with_matrix_units};
pub use merge::{MergeRule, merged_frames};
pub use operations::{add_operations, count_operations};
pub use pixel_norm::pixel_norm;
pub use precision::{ComputePrecision, with_precision};
pub use resample::{Resampling, resampled};
pub use residual_stack::{Stack, StackParameters, residual_stack};
pub use tv_flow::tv_flow;
pub use warp::{warp, warp_cubic};
