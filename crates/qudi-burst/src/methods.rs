//! The published classical methods, one per file.

mod average;
mod mle;
mod qbp;
mod transform_denoise;

pub use average::Average;
pub use mle::Mle;
pub use qbp::{PatchFlow, PostFilter, Qbp, QbpSettings};
pub use transform_denoise::TransformDenoise;
