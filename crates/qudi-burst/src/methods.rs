//! The methods, one a file.

mod average;
mod mle;
pub(crate) mod moving;
pub(crate) mod qbp;
pub(crate) mod transform_denoise;

pub use average::Average;
pub use mle::Mle;
pub use moving::{half_of_least_risk, moving_sums};
pub use qbp::{Finish, Qbp, QbpSettings};
pub use transform_denoise::TransformDenoise;
