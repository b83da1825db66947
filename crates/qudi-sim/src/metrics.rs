//! How close a restored frame is to the truth.

mod psnr;

pub use psnr::{best_gain, gain_aligned_psnr, psnr};
