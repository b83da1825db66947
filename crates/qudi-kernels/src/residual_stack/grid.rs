//! Pixels of many images in one line, with zeros between rows and between images.
//!
//! Every row is followed by one zero pixel and every image by one row of zeros, so that a tap of a 3 x 3
//! kernel is the same distance from every pixel: a convolution is a product of matrices over the whole line,
//! and so is the gradient of its weights.

use super::Stack;

/// Pixels of a tile of the matrix unit.
pub(super) const TILE: usize = 16;

/// Pixels of a block: two tiles.
pub(super) const BLOCK: usize = 2 * TILE;

/// The places of pixels in the line.
#[derive(Clone, Debug)]
pub(super) struct Grid {
    pub(super) images: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    /// For every tile from [`Self::first`] on, a bit for every place that is a pixel.
    pub(super) pixels: Vec<u16>,
}

impl Grid {
    pub(super) fn new(stack: &Stack) -> Self {
        let Stack { images, height, width, .. } = *stack;
        let mut grid = Self { images, height, width, pixels: Vec::new() };
        let tiles = (grid.end() - grid.first()).div_ceil(BLOCK) * 2;
        let (pitch, rows) = (grid.pitch(), height + 1);
        let is_pixel = |place: usize| {
            !place.is_multiple_of(pitch)
                && place < grid.end()
                && !(place / pitch).is_multiple_of(rows)
        };
        let bits = |tile: usize| {
            let first = grid.first() + tile * TILE;
            let bit = |k: usize| u16::from(is_pixel(first + k)) << k;
            (0..TILE).map(bit).sum()
        };
        grid.pixels = (0..tiles).map(bits).collect();
        grid
    }

    /// Returns the distance from a pixel to the one below.
    pub(super) fn pitch(&self) -> usize {
        self.width + 1
    }

    /// Returns the place of the first pixel; everything before is zero.
    pub(super) fn first(&self) -> usize {
        self.pitch() + 1
    }

    /// Returns the place after the last pixel.
    fn end(&self) -> usize {
        self.images * (self.height + 1) * self.pitch()
    }

    /// Returns the place of the first pixel of a row.
    pub(super) fn row(&self, image: usize, row: usize) -> usize {
        (image * (self.height + 1) + row + 1) * self.pitch() + 1
    }

    /// Returns the places between the first pixel and the end of the last block that are no pixels.
    pub(super) fn gaps(&self) -> impl Iterator<Item = std::ops::Range<usize>> {
        let rows =
            (0..self.images).flat_map(move |image| (0..self.height).map(move |row| (image, row)));
        let after = move |(image, row): (usize, usize)| {
            let end = self.row(image, row) + self.width;
            // The pixel between two rows, or the row between two images.
            end..if row + 1 < self.height { end + 1 } else { end + 1 + self.pitch() }
        };
        let last = self.last();
        rows.map(after)
            .map(move |gap| gap.start..gap.end.min(last))
            .chain(std::iter::once(self.end()..last))
    }

    /// Returns the number of blocks of pixels.
    pub(super) fn blocks(&self) -> usize {
        self.pixels.len() / 2
    }

    /// Returns the place after the last block.
    pub(super) fn last(&self) -> usize {
        self.first() + self.pixels.len() * TILE
    }

    /// Returns the length of the line with all that taps and tiles may read.
    pub(super) fn length(&self) -> usize {
        self.last() + self.pitch() + 1 + BLOCK
    }

    /// Returns the distance from a pixel to the one that a tap sees.
    pub(super) fn tap(&self, tap: usize) -> isize {
        let [row, column] = [tap / 3, tap % 3].map(|place| place as isize - 1);
        row * self.pitch() as isize + column
    }
}
