//! Frames side by side in one labelled picture.

use image::{ExtendedColorType, ImageEncoder};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use qudi_sim::scene::{GLYPH_HEIGHT, draw_text};
use std::path::Path;

const MARGIN: usize = 8;
const LABEL_SCALE: usize = 2;
const LABEL_HEIGHT: usize = GLYPH_HEIGHT * LABEL_SCALE + 6;

/// A grid of equally large frames with one or two lines of text above each.
#[derive(Debug)]
pub struct Picture {
    canvas: Frame,
    cell: Size,
    lines: usize,
}

impl Picture {
    /// Creates an empty grid.
    pub fn new(cell: Size, rows: usize, columns: usize, lines: usize) -> Self {
        let size = Size {
            height: MARGIN + rows * (cell.height + lines * LABEL_HEIGHT + MARGIN),
            width: MARGIN + columns * (cell.width + MARGIN),
        };
        Self { canvas: Frame::filled(size, 0.13), cell, lines }
    }

    /// Creates a picture of one frame, without margin or labels.
    pub fn single(frame: &Frame) -> Self {
        Self { canvas: frame.clone(), cell: frame.size, lines: 0 }
    }

    /// Places a frame with its labels into a cell.
    pub fn place(&mut self, row: usize, column: usize, labels: &[&str], frame: &Frame) {
        let x = MARGIN + column * (self.cell.width + MARGIN);
        let y = MARGIN + row * (self.cell.height + self.lines * LABEL_HEIGHT + MARGIN);
        for (n, label) in labels.iter().take(self.lines).enumerate() {
            draw_text(&mut self.canvas, (x, y + n * LABEL_HEIGHT), LABEL_SCALE, 0.92, label);
        }
        let top = y + self.lines * LABEL_HEIGHT;
        for row in 0..self.cell.height.min(frame.size.height) {
            let width = self.cell.width.min(frame.size.width);
            let start = (top + row) * self.canvas.size.width + x;
            self.canvas.data[start..start + width].copy_from_slice(&frame.row(row)[..width]);
        }
    }

    /// Returns the picture as one frame.
    pub fn into_frame(self) -> Frame {
        self.canvas
    }

    /// Encodes the picture as an 8-bit gray PNG.
    ///
    /// # Errors
    /// [`Error`] if it is too large for a PNG.
    pub fn to_png(&self) -> Result<Vec<u8>> {
        let mut png = Vec::new();
        self.encode(&mut png)
            .map_err(|e| Error::io("make", Path::new("the picture"), std::io::Error::other(e)))?;
        Ok(png)
    }

    fn encode(&self, out: impl std::io::Write) -> image::ImageResult<()> {
        let value = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let bytes: Vec<u8> = self.canvas.data.iter().map(value).collect();
        let Size { height, width } = self.canvas.size;
        image::codecs::png::PngEncoder::new(out).write_image(
            &bytes,
            width as u32,
            height as u32,
            ExtendedColorType::L8,
        )
    }

    /// Writes the picture as an 8-bit gray PNG.
    ///
    /// # Errors
    /// [`Error`] if the name is taken or the folder cannot be written.
    pub fn save(&self, path: &Path, overwrite: Overwrite) -> Result<()> {
        let mut file = PendingFile::create(path, overwrite)?;
        self.encode(&mut file).map_err(|e| Error::io("write", path, std::io::Error::other(e)))?;
        file.finish()
    }
}
