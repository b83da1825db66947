//! How close an estimate is to the truth.

mod psnr;
mod ssim;
mod statistics;
mod warp;

pub use psnr::{best_gain, gain_aligned_psnr, psnr};
pub use ssim::{gaussian_ssim, ssim};
pub use statistics::Statistics;
pub use warp::warping_error;
