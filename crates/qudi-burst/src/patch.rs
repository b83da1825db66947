//! Patches of 16 x 16 pixels: the unit of alignment and merging (Ma et al. 2020, section 5).

use multiversion::multiversion;
use qudi_core::{Frame, Size};
use std::ops::Range;

/// Side of a patch in pixels (Ma et al. 2020, section 5).
pub(crate) const SIDE: usize = 16;

/// Samples of a patch, by row.
pub(crate) type Patch = [[f32; SIDE]; SIDE];

/// Displacements or velocities of all patches, `[frame][patch]`, right and down in pixels.
pub(crate) type PatchMotion = Vec<Vec<[f32; 2]>>;

/// Enlarges an image of size `from` to `size` by repeating its last row and column.
pub(crate) fn padded(values: &[f32], from: Size, size: Size) -> Frame {
    Frame::from_fn(size, |x, y| values[y.min(from.height - 1) * from.width + x.min(from.width - 1)])
}

/// Returns the size of an image enlarged to hold at least one patch.
pub(crate) fn padded_size(size: Size) -> Size {
    Size { height: size.height.max(SIDE), width: size.width.max(SIDE) }
}

/// Returns the range of a patch's samples that lie inside an image of `length` pixels along one axis. The
/// patch starts at `start`.
pub(crate) fn inside(start: f32, length: usize) -> Range<usize> {
    let first = (-0.5 - start).ceil().clamp(0.0, SIDE as f32);
    let end = ((length as f32 - 0.5 - start).floor() + 1.0).clamp(first, SIDE as f32);
    first as usize..end as usize
}

/// Samples the patch whose corner is at `corner` bilinearly; the image's borders are repeated.
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn bilinear(image: &Frame, corner: [f32; 2]) -> Patch {
    let samples = BilinearSamples::new(image, corner);
    let mut patch = [[0.0; SIDE]; SIDE];
    for (r, row) in patch.iter_mut().enumerate() {
        *row = samples.row(r);
    }
    patch
}

/// Row-wise [`bilinear`], inlined to be compiled for the vector unit of its caller.
pub(crate) struct BilinearSamples<'a> {
    image: &'a Frame,
    /// Pixel before the corner.
    corner: [isize; 2],
    weights: [f32; 4],
    /// True if all columns lie inside the image.
    within: bool,
}

impl<'a> BilinearSamples<'a> {
    #[inline(always)]
    pub(crate) fn new(image: &'a Frame, corner: [f32; 2]) -> Self {
        let [x, y] = [corner[0].floor(), corner[1].floor()];
        let [fx, fy] = [corner[0] - x, corner[1] - y];
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let corner = [x as isize, y as isize];
        let within = corner[0] >= 0 && corner[0] + (SIDE as isize) < image.size.width as isize;
        Self { image, corner, weights, within }
    }

    /// Returns row `r` of the patch.
    #[inline(always)]
    pub(crate) fn row(&self, r: usize) -> [f32; SIDE] {
        let (upper, lower) = (self.source(r), self.source(r + 1));
        if self.within {
            let x = self.corner[0] as usize;
            return between(self.weights, &upper[x..=x + SIDE], &lower[x..=x + SIDE]);
        }
        let (mut above, mut below) = ([0.0; SIDE + 1], [0.0; SIDE + 1]);
        let last = upper.len() as isize - 1;
        for c in 0..=SIDE {
            let x = (self.corner[0] + c as isize).clamp(0, last) as usize;
            (above[c], below[c]) = (upper[x], lower[x]);
        }
        between(self.weights, &above, &below)
    }

    /// Returns the row of the image nearest to row `r` of the patch.
    #[inline(always)]
    fn source(&self, r: usize) -> &'a [f32] {
        let last = self.image.size.height as isize - 1;
        self.image.row((self.corner[1] + r as isize).clamp(0, last) as usize)
    }
}

/// Interpolates a row between the pixels of two rows.
#[inline(always)]
fn between(weights: [f32; 4], upper: &[f32], lower: &[f32]) -> [f32; SIDE] {
    let (a, b) = (&upper[..SIDE], &upper[1..=SIDE]);
    let (c, d) = (&lower[..SIDE], &lower[1..=SIDE]);
    // A plain loop: closures are not compiled for the caller's vector unit.
    let mut row = [0.0; SIDE];
    for x in 0..SIDE {
        row[x] = a[x] * weights[0] + b[x] * weights[1] + c[x] * weights[2] + d[x] * weights[3];
    }
    row
}

/// Returns the sum of all samples of a patch, computed sixteen at a time.
#[inline(always)]
pub(crate) fn total(patch: &Patch) -> f32 {
    let mut lanes = [0.0f32; SIDE];
    for row in patch {
        for (lane, value) in lanes.iter_mut().zip(row) {
            *lane += value;
        }
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_samples_inside_the_image_to_half_a_pixel() {
        assert_eq!(inside(0.0, 40), 0..16);
        assert_eq!(inside(-3.0, 40), 3..16);
        assert_eq!(inside(-2.6, 40), 3..16);
        assert_eq!(inside(-2.4, 40), 2..16);
        assert_eq!(inside(24.4, 40), 0..16);
        assert_eq!(inside(24.6, 40), 0..15);
        assert_eq!(inside(38.0, 40), 0..2);
        assert!(inside(60.0, 40).is_empty() && inside(-60.0, 40).is_empty());
    }
}
