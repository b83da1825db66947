//! Classical restoration of single-photon bursts: the methods of the field, written from their papers, and
//! the reference estimate that a network goes on from.
//!
//! All methods are [`Restorer`](qudi_core::restorer::Restorer)s: a window of counts `[frames][height][width]`
//! in, all its frames out, in image units. Constants were chosen on training clips, those of the
//! [`ReferenceEstimate`] on validation clips.
#![warn(missing_docs)]
// Loops over patches are inlined into functions that are compiled for the vector unit, and plain for them.
#![allow(clippy::inline_always, clippy::needless_range_loop)]

mod aligned_burst;
mod aligned_sums;
mod denoise;
mod merge;
pub mod methods;
pub mod motion;
mod moving_sums;
mod patch;
mod prepared_burst;
mod reference;
mod temporal_filter;

pub use aligned_burst::{AlignedBurst, AlignedFrame, Alignments};
pub use aligned_sums::{AlignedSums, choose_count};
pub use denoise::bm3d::bm3d;
pub use denoise::vst::{Transform, VarianceStabilizer};
pub use methods::{Average, Mle, PatchFlow, PostFilter, Qbp, QbpSettings, TransformDenoise};
pub use moving_sums::{moving_sums, sure_window_radius};
pub use reference::{QbpRefined, ReferenceEstimate};
