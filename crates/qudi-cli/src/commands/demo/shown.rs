//! What the demo shows of every method.

use qudi_core::Frame;

/// The number of frames of the paper's window.
pub(super) const FRAMES: usize = 11;

/// The factor by which errors and uncertainty are shown brighter than images.
pub(super) const ERROR_GAIN: f32 = 4.0;

/// The centre frame as a method restored it.
pub(super) struct Shown {
    pub(super) label: &'static str,
    pub(super) name: &'static str,
    /// Description of the method.
    pub(super) how: String,
    pub(super) frame: Frame,
    pub(super) psnr_a: f64,
    pub(super) psnr: f64,
    pub(super) ssim: f64,
    pub(super) seconds: f64,
}
