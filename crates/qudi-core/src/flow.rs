//! Optical flow.

use crate::frame::Size;

/// Displacement of the surface seen at each pixel, in pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Flow {
    /// Rows and columns.
    pub size: Size,
    /// Horizontal displacement, `[height * width]`.
    pub dx: Vec<f32>,
    /// Vertical displacement, `[height * width]`.
    pub dy: Vec<f32>,
    /// Whether the surface is inside the frame and not hidden at the target time.
    pub visible: Vec<bool>,
}
