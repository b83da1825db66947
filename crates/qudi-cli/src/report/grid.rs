//! Colour frames side by side under labels: a grid for each of red, green and blue.

use super::player::encoded_rgb;
use crate::error::{CliError, Result};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use qudi_core::{Frame, Size};
use qudi_io::writer::Picture;

/// A grid of equally large colour frames with lines of text above each.
pub(crate) struct Grid([Picture; 3]);

/// Red, green and blue of every pixel.
pub(crate) struct Pixels {
    pub(crate) size: Size,
    pub(crate) rgb: Vec<u8>,
}

impl Grid {
    /// Creates an empty grid.
    pub(crate) fn new(cell: Size, rows: usize, columns: usize, lines: usize) -> Self {
        Self([(); 3].map(|()| Picture::new(cell, rows, columns, lines)))
    }

    /// Places red, green and blue of a frame with its labels into a cell.
    pub(crate) fn place(
        &mut self,
        row: usize,
        column: usize,
        labels: &[&str],
        planes: [&Frame; 3],
    ) {
        for (picture, plane) in self.0.iter_mut().zip(planes) {
            picture.place(row, column, labels, plane);
        }
    }

    /// Returns the pixels of the grid.
    pub(crate) fn pixels(self) -> Pixels {
        let planes = self.0.map(Picture::into_frame);
        let size = planes[0].size;
        let value = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let pixel = |i: usize| planes.each_ref().map(|plane| value(plane.data[i]));
        Pixels { size, rgb: (0..size.pixels()).flat_map(pixel).collect() }
    }

    /// Encodes the grid as a JPEG.
    pub(crate) fn jpeg(self, quality: u8) -> Vec<u8> {
        let Pixels { size, rgb } = self.pixels();
        encoded_rgb(&rgb, size, quality)
    }

    /// Encodes the grid as a PNG.
    pub(crate) fn png(self) -> Result<Vec<u8>> {
        let Pixels { size, rgb } = self.pixels();
        let mut png = Vec::new();
        let (width, height) = (size.width as u32, size.height as u32);
        PngEncoder::new_with_quality(&mut png, CompressionType::Best, FilterType::Adaptive)
            .write_image(&rgb, width, height, ExtendedColorType::Rgb8)
            .map_err(|e| CliError::new(e, "the picture", "report this as a bug"))?;
        Ok(png)
    }
}
