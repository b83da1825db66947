//! The planes that a convolution reads, and their copy into scratch memory.

use super::pass::{Pass, Tiling};
use super::scratch::{Format, Row, fill_row};

/// Inputs joined by channel, `[images, channels, height, width]` each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source<'a> {
    /// Values and channels of every input.
    pub(super) inputs: &'a [(&'a [f32], usize)],
    /// Where this, of the shape of the only input, is not positive, the input counts as zero.
    pub(super) mask: Option<&'a [f32]>,
    /// Frames of one burst.
    pub(super) frames: usize,
    /// Grid of the inputs.
    pub(super) height: usize,
    pub(super) width: usize,
    /// Frames that the kernel covers.
    pub(super) depth: usize,
}

impl<'a> Source<'a> {
    /// Channel `number / depth` of the frame `number % depth - depth / 2` away from `image`, and its mask;
    /// nothing past the ends of the burst.
    fn plane(&self, image: usize, number: usize) -> Option<(&'a [f32], Option<&'a [f32]>)> {
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

    /// Copies what a tile of `pass` needs of the scratch planes `planes` of `image`, zeros around the edges.
    /// The last row of scratch is spare.
    pub(super) fn fill(
        &self,
        image: usize,
        planes: std::ops::Range<usize>,
        pass: &Pass,
        tiling: &Tiling,
        at: [usize; 2],
        scratch: &mut [f32],
    ) {
        let top = pass.first[0] + (pass.stride * at[0]) as isize;
        let left = pass.first[1] + (pass.stride * at[1]) as isize;
        let (scratch, spare) = scratch.split_at_mut(scratch.len() - tiling.row);
        let format = tiling.format;
        for (number, to) in planes.zip(scratch.chunks_exact_mut(tiling.plane())) {
            let sources = match format {
                Format::Single | Format::Rounded => [self.plane(image, number), None],
                Format::Pairs | Format::Tiles(_) => {
                    [2 * number, 2 * number + 1].map(|number| self.plane(image, number))
                }
            };
            for (row, to) in (top..).zip(to.chunks_exact_mut(tiling.row)) {
                if row < 0 || row >= self.height as isize {
                    to.fill(0.0);
                    continue;
                }
                let place = row as usize * self.width..(row as usize + 1) * self.width;
                let rows: [Option<Row<'_>>; 2] = sources.map(|source| {
                    let (plane, mask) = source?;
                    Some((&plane[place.clone()], mask.map(|mask| &mask[place.clone()])))
                });
                if pass.stride == 1 {
                    fill_row(format, rows, left, 1, to, spare);
                } else {
                    let (even, odd) = to.split_at_mut(tiling.half);
                    fill_row(format, rows, left, 2, even, spare);
                    fill_row(format, rows, left + 1, 2, odd, spare);
                }
            }
        }
    }
}

/// `to[i] = from[left + i * step]`, zero outside and where the mask is not positive.
pub(super) fn copy_row(
    from: &[f32],
    mask: Option<&[f32]>,
    left: isize,
    step: usize,
    to: &mut [f32],
) {
    let step = step as isize;
    // The first and the end of the places inside.
    let inside = |place: isize| (place.max(0) as usize).min(to.len());
    let start = inside((-left + step - 1).div_euclid(step));
    let end = inside((from.len() as isize - left + step - 1).div_euclid(step)).max(start);
    to[..start].fill(0.0);
    to[end..].fill(0.0);
    if start == end {
        return;
    }
    let offset = (left + start as isize * step) as usize;
    let to = &mut to[start..end];
    match mask {
        None if step == 1 => to.copy_from_slice(&from[offset..offset + to.len()]),
        None => {
            for (to, &from) in to.iter_mut().zip(from[offset..].iter().step_by(step as usize)) {
                *to = from;
            }
        }
        // Only gradients are masked, and those are read one by one.
        Some(mask) => {
            debug_assert_eq!(step, 1);
            let pairs = from[offset..].iter().zip(&mask[offset..]);
            for (to, (&from, &mask)) in to.iter_mut().zip(pairs) {
                *to = if mask > 0.0 { from } else { 0.0 };
            }
        }
    }
}

impl Source<'_> {
    /// Copies a tile of every plane, rows of `length` values with zeros past the tile.
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
                let start = row * self.width + at[1];
                let place = start..start + size[1];
                copy_row(&plane[place.clone()], mask.map(|mask| &mask[place]), 0, 1, to);
            }
        }
    }
}
