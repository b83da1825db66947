//! Padding and tiling of images for a network: images are mirrored at their edges up to the required size,
//! and cut into tiles.

mod tiles;

use crate::tensor::read;
use burn::tensor::Tensor;
use qudi_core::{Frame, Result, Size};

pub use tiles::Tiles;

/// Default side of tiles, in pixels.
pub const TILE: usize = 512;

/// Mirrors a position into a row of `count` values, without repeating the ends.
pub fn mirrored(place: i64, count: usize) -> usize {
    let period = (2 * count as i64 - 2).max(1);
    let place = place.rem_euclid(period);
    (if place < count as i64 { place } else { period - place }) as usize
}

/// Padding and tiling of images of one size.
#[derive(Debug)]
pub struct Tiling {
    /// Size of the images.
    from: Size,
    /// Size of the padded images.
    pub size: Size,
    /// Tiles of the padded images.
    pub tiles: Tiles,
}

impl Tiling {
    /// Plans the tiling of images of size `from` for a network that requires multiples of `multiple`, in
    /// tiles of about `side` pixels.
    pub fn new(from: Size, multiple: usize, side: usize) -> Self {
        let size = Size {
            height: from.height.next_multiple_of(multiple),
            width: from.width.next_multiple_of(multiple),
        };
        let side = side / multiple * multiple;
        let overlap = (side / 8).next_multiple_of(multiple);
        Self { from, size, tiles: Tiles::new(size, side, overlap, multiple) }
    }

    /// Pads images by mirroring them at their lower and right edges.
    pub fn padded<T: Copy>(&self, images: &[T]) -> Vec<T> {
        let Self { from, size, .. } = self;
        let mut values = Vec::with_capacity(images.len() / from.pixels() * size.pixels());
        for image in images.chunks_exact(from.pixels()) {
            for y in 0..size.height {
                let row = &image[mirrored(y as i64, from.height) * from.width..][..from.width];
                values.extend_from_slice(row);
                let beyond = from.width..size.width;
                values.extend(beyond.map(|x| row[mirrored(x as i64, from.width)]));
            }
        }
        values
    }

    /// Crops padded images to frames of the original size.
    pub fn frames(&self, images: &[f32]) -> Vec<Frame> {
        let cropped = |image: &[f32]| {
            let rows = image.chunks_exact(self.size.width).take(self.from.height);
            let values = rows.flat_map(|row| &row[..self.from.width]).copied();
            Frame { size: self.from, data: values.collect() }
        };
        images.chunks_exact(self.size.pixels()).map(cropped).collect()
    }

    /// Joins the tiles of one or more images and crops them; `of_tile` computes a tile by its number.
    ///
    /// # Errors
    /// Errors of `of_tile`, and [`Error`](qudi_core::Error) if the device fails.
    pub fn joined(
        &self,
        mut of_tile: impl FnMut(usize) -> Result<Vec<Tensor<4>>>,
    ) -> Result<Vec<Frame>> {
        let tiles = &self.tiles;
        let mut images: Vec<Vec<f32>> = Vec::new();
        for number in 0..tiles.count() {
            let parts = of_tile(number)?;
            images.resize(parts.len(), vec![0.0; self.size.pixels()]);
            for (part, image) in parts.into_iter().zip(&mut images) {
                tiles.blend(number, &read(part)?, image);
            }
        }
        Ok(images.iter().flat_map(|image| self.frames(image)).collect())
    }
}
