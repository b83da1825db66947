//! How images lie before the network: mirrored at their edges up to what it wants, in tiles, and back.

use crate::measurement::GuidePlanes;
use crate::restorer::tiles::Tiles;
use crate::tensor::read;
use burn::tensor::{Device, Tensor};
use qudi_core::{Frame, Result, Size};

/// See the module.
#[derive(Debug)]
pub(crate) struct Layout {
    /// Of the images.
    from: Size,
    /// Of the images, padded.
    pub(crate) size: Size,
    /// Of the padded images.
    pub(crate) tiles: Tiles,
}

impl Layout {
    /// For images of size `from` and a network that wants multiples of `multiple`, in tiles of about `side` pixels.
    pub(crate) fn new(from: Size, multiple: usize, side: usize) -> Self {
        let size = Size {
            height: from.height.next_multiple_of(multiple),
            width: from.width.next_multiple_of(multiple),
        };
        let side = side / multiple * multiple;
        let overlap = (side / 8).next_multiple_of(multiple);
        Self { from, size, tiles: Tiles::new(size, side, overlap, multiple) }
    }

    /// Images mirrored at their lower and right edges.
    pub(crate) fn padded(&self, images: &[f32]) -> Vec<f32> {
        let Self { from, size, .. } = self;
        // 0 1 2 3 2 1 0 1 2 ...: the edge itself is not repeated.
        let mirror = |place: usize, length: usize| {
            let period = (2 * length - 2).max(1);
            let place = place % period;
            if place < length { place } else { period - place }
        };
        let mut values = Vec::with_capacity(images.len() / from.pixels() * size.pixels());
        for image in images.chunks_exact(from.pixels()) {
            for y in 0..size.height {
                let row = mirror(y, from.height) * from.width;
                values.extend((0..size.width).map(|x| image[row + mirror(x, from.width)]));
            }
        }
        values
    }

    /// Padded images as they were before.
    pub(crate) fn frames(&self, images: &[f32]) -> Vec<Frame> {
        let cropped = |image: &[f32]| {
            let rows = image.chunks_exact(self.size.width).take(self.from.height);
            let values = rows.flat_map(|row| &row[..self.from.width]).copied();
            Frame { size: self.from, data: values.collect() }
        };
        images.chunks_exact(self.size.pixels()).map(cropped).collect()
    }

    /// What `denoise` makes of a frame, in image units, from its padded guide: one image or several, cropped.
    pub(crate) fn denoised(
        &self,
        guide: &GuidePlanes,
        device: &Device,
        denoise: impl Fn(&Tensor<4>) -> Vec<Tensor<4>>,
    ) -> Result<Vec<Frame>> {
        let tiles = &self.tiles;
        let mut images: Vec<Vec<f32>> = Vec::new();
        for number in 0..tiles.count() {
            let guide = guide.map(|plane| tiles.crop(number, plane));
            let guide = guide.into_tensor(tiles.tile, device);
            let parts = denoise(&guide);
            images.resize(parts.len(), vec![0.0; self.size.pixels()]);
            for (part, image) in parts.into_iter().zip(&mut images) {
                tiles.blend(number, &read(part)?, image);
            }
        }
        Ok(images.iter().flat_map(|image| self.frames(image)).collect())
    }
}
