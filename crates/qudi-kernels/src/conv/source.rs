//! Input planes of a convolution, and their copy into scratch memory.

use super::pass::{Pass, Tiling};
use super::scratch::{Format, Row, copy, fill_row};
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// Inputs joined by channel, `[images, channels, height, width]` each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source<'a> {
    /// Values and number of channels of each input.
    pub(super) inputs: &'a [(&'a [f32], usize)],
    /// Mask of the shape of the only input: where it is not positive, the input counts as zero.
    pub(super) mask: Option<&'a [f32]>,
    /// Frames per burst.
    pub(super) frames: usize,
    /// Height of the inputs.
    pub(super) height: usize,
    pub(super) width: usize,
    /// Number of frames that the kernel covers.
    pub(super) depth: usize,
}

impl<'a> Source<'a> {
    /// Returns channel `number / depth` of the frame `number % depth - depth / 2` away from `image`, and its
    /// mask. Returns `None` outside the burst.
    pub(super) fn plane(&self, image: usize, number: usize) -> Option<Row<'a>> {
        let (mut channel, delta) = (number / self.depth, number % self.depth);
        let frame = (image % self.frames + delta).checked_sub(self.depth / 2)?;
        if frame >= self.frames {
            return None;
        }
        let image = image - image % self.frames + frame;
        let size = self.height * self.width;
        for &(values, channels) in self.inputs {
            if channel < channels {
                let start = (image * channels + channel) * size;
                let mask = self.mask.map(|mask| &mask[start..start + size]);
                return Some((&values[start..start + size], mask));
            }
            channel -= channels;
        }
        None
    }

    /// Copies the input of a tile of `pass` from the scratch planes `planes` of `image` to `scratch`, with
    /// zeros around the edges.
    pub(super) fn fill(
        self,
        image: usize,
        planes: Range<usize>,
        pass: &Pass,
        tiling: &Tiling,
        at: [usize; 2],
        scratch: &mut [f32],
    ) {
        Arch::new().dispatch(Fill { source: self, image, planes, pass, tiling, at, scratch });
    }

    /// Copies a tile of every plane, in rows of `length` values with zeros after the tile.
    pub(super) fn copy_tile(
        &self,
        image: usize,
        at: [usize; 2],
        size: [usize; 2],
        length: usize,
        to: &mut [f32],
    ) {
        for (number, to) in to.chunks_exact_mut(size[0] * length).enumerate() {
            let Some((plane, mask)) = self.plane(image, number) else { continue };
            for (row, to) in (at[0]..).zip(to.chunks_exact_mut(length)) {
                let (to, past) = to.split_at_mut(size[1]);
                copy((plane, mask), row * self.width + at[1], 1, to);
                past.fill(0.0);
            }
        }
    }
}

/// Implementation of [`Source::fill`]. A struct, since closures are not compiled for the vector unit.
struct Fill<'a> {
    source: Source<'a>,
    image: usize,
    planes: Range<usize>,
    pass: &'a Pass,
    tiling: &'a Tiling,
    at: [usize; 2],
    scratch: &'a mut [f32],
}

impl WithSimd for Fill<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { source, image, planes, pass, tiling, at, scratch } = self;
        let top = pass.first[0] + (pass.stride * at[0]) as isize;
        let left = pass.first[1] + (pass.stride * at[1]) as isize;
        let format = tiling.format;
        for (number, to) in planes.zip(scratch.chunks_exact_mut(tiling.plane())) {
            let sources = match format {
                Format::Single | Format::Rounded => [source.plane(image, number), None],
                Format::Pairs | Format::Tiles(_) => {
                    [source.plane(image, 2 * number), source.plane(image, 2 * number + 1)]
                }
            };
            for (row, to) in (top..).zip(to.chunks_exact_mut(tiling.row)) {
                if row < 0 || row >= source.height as isize {
                    to.fill(0.0);
                    continue;
                }
                let start = row as usize * source.width;
                let rows = [
                    row_of(sources[0], start, source.width),
                    row_of(sources[1], start, source.width),
                ];
                if pass.stride == 1 {
                    fill_row(format, rows, left, 1, to);
                } else {
                    let (even, odd) = to.split_at_mut(tiling.half);
                    fill_row(format, rows, left, 2, even);
                    fill_row(format, rows, left + 1, 2, odd);
                }
            }
        }
    }
}

/// Returns the row of a plane that begins at `start`.
#[inline(always)]
fn row_of(plane: Option<Row<'_>>, start: usize, width: usize) -> Option<Row<'_>> {
    let (values, mask) = plane?;
    Some((&values[start..start + width], mask.map(|mask| &mask[start..start + width])))
}
