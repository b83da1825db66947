//! The methods, one a file.

mod average;
mod mle;
pub(crate) mod moving;
pub(crate) mod qbp;
pub(crate) mod transform_denoise;

pub use average::Average;
pub use mle::Mle;
pub use moving::{moving_sums, sure_window_radius};
pub use qbp::{PostFilter, Qbp, QbpSettings};
pub use transform_denoise::TransformDenoise;
