//! The classical methods of the field's tables, written from their papers: a tool that beats
//! methods should beat them at their best.
//!
//! All are [`Restorer`](qudi_sim::restore::Restorer)s: a window of counts `[frames][height][width]` in,
//! all its frames out, in image units. Constants were chosen on training clips, but those of
//! the [`Guide`]; docs/results.md tells how.
#![warn(missing_docs)]

mod bm3d;
mod plane;
mod qbp;
mod stabilizer;
mod transform_denoise;

pub use bm3d::bm3d;
pub use qbp::{Aligned, Alignment, Along, Finish, Guide, PatchFlow, Qbp, QbpSettings, TwoRounds};
pub use stabilizer::{Stabilizer, Transform};
pub use transform_denoise::TransformDenoise;
