//! How close an estimate is to the truth.

mod chi_square;
mod psnr;
mod ssim;
mod statistics;

pub use chi_square::Consistency;
pub use psnr::{best_gain, gain_aligned_psnr, psnr};
pub use ssim::{gaussian_ssim, ssim};
pub use statistics::Statistics;
