//! The classical methods of the field's tables, written from their papers: a tool that beats
//! methods should beat them at their best.
//!
//! All are [`Restorer`](qudi_core::restorer::Restorer)s: a window of counts `[frames][height][width]` in,
//! all its frames out, in image units. Constants were chosen on training clips, but those of
//! the [`ReferenceEstimate`]; docs/results.md tells how.
#![warn(missing_docs)]

mod aligned;
mod denoise;
mod guide;
mod merge;
pub mod methods;
pub mod motion;
mod steady;

pub use aligned::{AlignedBurst, AlignedFrame, Alignments};
pub use denoise::bm3d::bm3d;
pub use denoise::stabilizer::{Transform, VarianceStabilizer};
pub use guide::{QbpRefined, ReferenceEstimate};
pub use methods::qbp::PatchFlow;
pub use methods::{
    Average, Mle, PostFilter, Qbp, QbpSettings, TransformDenoise, moving_sums, sure_window_radius,
};
