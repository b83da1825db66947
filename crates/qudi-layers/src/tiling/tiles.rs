//! Overlapping tiles of a frame, and blending of their results.

use qudi_core::Size;

/// Positions of tiles of one size on a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tiles {
    frame: Size,
    /// Size of each tile.
    pub tile: Size,
    rows: Vec<usize>,
    columns: Vec<usize>,
}

impl Tiles {
    /// Plans tiles of `side` pixels (smaller where the frame is) that overlap by at least `overlap`. Frame,
    /// side and overlap must be multiples of `multiple`; all positions are, too.
    pub fn new(frame: Size, side: usize, overlap: usize, multiple: usize) -> Self {
        let starts = |length: usize| {
            let side = side.min(length);
            let count = (length - side).div_ceil((side - overlap.min(side / 2)).max(1)) + 1;
            let place = |n: usize| {
                let exact = (length - side) * n / (count - 1).max(1);
                exact / multiple * multiple
            };
            (0..count).map(|n| if n + 1 == count { length - side } else { place(n) }).collect()
        };
        let tile = Size { height: side.min(frame.height), width: side.min(frame.width) };
        Self { frame, tile, rows: starts(frame.height), columns: starts(frame.width) }
    }

    /// Returns the number of tiles.
    pub fn count(&self) -> usize {
        self.rows.len() * self.columns.len()
    }

    /// Returns the first row and column of a tile.
    fn corner(&self, number: usize) -> [usize; 2] {
        [self.rows[number / self.columns.len()], self.columns[number % self.columns.len()]]
    }

    /// Crops tile `number` from every image.
    pub fn crop<T: Copy>(&self, number: usize, images: &[T]) -> Vec<T> {
        let [top, left] = self.corner(number);
        let mut values =
            Vec::with_capacity(images.len() / self.frame.pixels() * self.tile.pixels());
        for image in images.chunks_exact(self.frame.pixels()) {
            for row in top..top + self.tile.height {
                let start = row * self.frame.width + left;
                values.extend_from_slice(&image[start..start + self.tile.width]);
            }
        }
        values
    }

    /// Writes tile `number` of every image into `images`, over what other tiles have written.
    pub fn place(&self, number: usize, tiles: &[f32], images: &mut [f32]) {
        let [top, left] = self.corner(number);
        let images = images.chunks_exact_mut(self.frame.pixels());
        for (image, tile) in images.zip(tiles.chunks_exact(self.tile.pixels())) {
            for (y, values) in tile.chunks_exact(self.tile.width).enumerate() {
                let start = (top + y) * self.frame.width + left;
                image[start..start + self.tile.width].copy_from_slice(values);
            }
        }
    }

    /// Adds tile `number` of every image to `images`. The weights of overlapping tiles add up to one.
    pub fn blend(&self, number: usize, tiles: &[f32], images: &mut [f32]) {
        let [top, left] = self.corner(number);
        let rows = shares(&self.rows, self.tile.height, number / self.columns.len());
        let columns = shares(&self.columns, self.tile.width, number % self.columns.len());
        let images = images.chunks_exact_mut(self.frame.pixels());
        for (image, tile) in images.zip(tiles.chunks_exact(self.tile.pixels())) {
            for (y, (values, row)) in tile.chunks_exact(self.tile.width).zip(&rows).enumerate() {
                let start = (top + y) * self.frame.width + left;
                let target = &mut image[start..start + self.tile.width];
                for ((target, value), column) in target.iter_mut().zip(values).zip(&columns) {
                    *target += value * row * column;
                }
            }
        }
    }
}

/// Returns the weights of tile `number` along one axis: ramps over the overlaps, normalised by the sum over
/// all tiles.
fn shares(starts: &[usize], side: usize, number: usize) -> Vec<f32> {
    let weight = |n: usize, place: usize| -> f32 {
        let Some(i) = place.checked_sub(starts[n]).filter(|&i| i < side) else { return 0.0 };
        let before = if n > 0 { (starts[n - 1] + side).saturating_sub(starts[n]) } else { 0 };
        let after = starts.get(n + 1).map_or(0, |next| (starts[n] + side).saturating_sub(*next));
        let rise = if i < before { (i as f32 + 0.5) / before as f32 } else { 1.0 };
        let back = side - 1 - i;
        let fall = if back < after { (back as f32 + 0.5) / after as f32 } else { 1.0 };
        rise.min(fall)
    };
    (starts[number]..starts[number] + side)
        .map(|place| {
            let all: f32 = (0..starts.len()).map(|n| weight(n, place)).sum();
            weight(number, place) / all
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_cover_every_pixel_once() {
        for (height, width, side, overlap) in
            [(64, 64, 64, 16), (96, 208, 64, 16), (16, 512, 48, 16), (128, 80, 32, 16)]
        {
            let frame = Size { height, width };
            let tiles = Tiles::new(frame, side, overlap, 16);
            let image: Vec<f32> = (0..2 * frame.pixels()).map(|i| (i % 97) as f32).collect();
            let [mut sum, mut placed] = [vec![0.0; image.len()], vec![-1.0; image.len()]];
            for number in 0..tiles.count() {
                assert!(tiles.corner(number).iter().all(|start| start % 16 == 0));
                tiles.blend(number, &tiles.crop(number, &image), &mut sum);
                tiles.place(number, &tiles.crop(number, &image), &mut placed);
            }
            assert_eq!(placed, image, "{frame}, tiles of {side}");
            for (sum, value) in sum.iter().zip(&image) {
                assert!((sum - value).abs() < 1e-4, "{frame}, tiles of {side}: {sum}, {value}");
            }
        }
    }
}
