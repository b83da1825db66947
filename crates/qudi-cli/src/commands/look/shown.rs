//! A picture for the eye, gray or in colour.

use super::mosaic::with_white_at_highlights;
use crate::colour::{Rendering, encoded};
use crate::report::player::{QUALITY, colour_url, picture_url};
use qudi_core::{Frame, linear_to_srgb};

/// A picture with the tone curve of screens.
pub(super) enum Shown {
    Gray(Frame),
    Colour(Box<[Frame; 3]>),
}

impl Shown {
    /// Applies the tone curve to a gray picture in linear light.
    pub(super) fn gray(mut frame: Frame) -> Self {
        for value in &mut frame.data {
            *value = linear_to_srgb(*value);
        }
        Self::Gray(frame)
    }

    /// Renders sensor colours in linear light.
    pub(super) fn colour(planes: &[Frame; 3], rendering: &Rendering) -> Self {
        Self::Colour(Box::new(encoded(&with_white_at_highlights(rendering.rendered(planes)))))
    }

    /// Encodes the picture for a page.
    pub(super) fn url(&self) -> String {
        match self {
            Self::Gray(frame) => picture_url(frame, QUALITY),
            Self::Colour(planes) => colour_url(planes, QUALITY),
        }
    }

    /// Returns red, green and blue.
    pub(super) fn planes(&self) -> [&Frame; 3] {
        match self {
            Self::Gray(frame) => [frame; 3],
            Self::Colour(planes) => planes.each_ref(),
        }
    }
}
