//! Classical restoration of single-photon bursts: published methods, written from their papers, and the
//! reference estimate on which the networks build.
//!
//! All methods are [`Restorer`](qudi_core::restorer::Restorer)s: they take a window of counts
//! `[frames][height][width]` and return all its frames in image units. Their constants were chosen on
//! training clips; the constants of [`ReferenceEstimate`] were chosen on validation clips.
#![warn(missing_docs)]
// Loops over patches are inlined into functions compiled for the vector unit, and stay simple for the
// compiler.
#![allow(clippy::inline_always, clippy::needless_range_loop)]

mod aligned_burst;
mod aligned_sums;
mod burst_motion;
mod colour;
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
pub use burst_motion::{BurstMotion, CellMotion, FoundMotion};
pub use colour::{ColourCorrector, ColourEvidence, ColourRestorer, CorrectedColours, PlaneFrames};
pub use denoise::bm3d::bm3d;
pub use denoise::vst::{Transform, VarianceStabilizer};
pub use methods::{Average, Mle, PatchFlow, PostFilter, Qbp, QbpSettings, TransformDenoise};
pub use moving_sums::{moving_sums, sure_window_radius};
pub use reference::{QbpRefined, ReferenceEstimate};
