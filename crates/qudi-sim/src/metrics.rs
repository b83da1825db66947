//! How close an estimate is to the truth.

mod block_flow;
mod psnr;
mod ssim;
mod statistics;
mod warp;

pub use block_flow::estimate_flow;
pub use psnr::{best_gain, gain_aligned_psnr, psnr};
pub use ssim::{gaussian_ssim, ssim};
pub use statistics::Statistics;
pub use warp::warping_error;
