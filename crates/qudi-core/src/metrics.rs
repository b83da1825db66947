//! Metrics of an estimate against the truth.

mod calibration;
mod chi_square;
mod colour;
mod detail;
mod gmsd;
mod octaves;
mod psnr;
mod ssim;
mod statistics;

pub use calibration::{Calibration, calibration};
pub use chi_square::Consistency;
pub use colour::{colour_psnr, common_gain, zipper_error};
pub use detail::{Detail, detail};
pub use gmsd::gmsd;
pub use octaves::{OCTAVES, octave_energies};
pub use psnr::{MAX_PSNR, best_gain, gain_aligned_psnr, psnr};
pub use ssim::{gaussian_ssim, ssim};
pub use statistics::Statistics;
