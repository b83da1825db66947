//! Images between planes of 32 bits and lines of bfloat16 with channels last.
#![allow(unsafe_code)]

use super::buffer::Buffer;
use super::grid::{Grid, TILE};
use super::transposition::transposed;
use crate::conv::upper;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::ops::Range;

/// Rows of an image that one thread converts at once.
const BAND_ROWS: usize = 16;

/// Channels of a block: one row of a tile.
pub(super) const CHANNELS: usize = 32;

/// A line of pixels, bfloat16, channels last. Places that are no pixels are zero.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub(super) values: Buffer,
    pub(super) channels: usize,
}

/// A pointer that threads share; each writes places of its own.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shared<T>(pub(super) *mut T);

// SAFETY: every thread writes places that no other one reads or writes.
unsafe impl<T> Send for Shared<T> {}
// SAFETY: likewise.
unsafe impl<T> Sync for Shared<T> {}

impl<T> Shared<T> {
    pub(super) fn at(self, place: usize) -> *mut T {
        self.0.wrapping_add(place)
    }
}

/// Rounds to bfloat16.
#[inline(always)]
pub(super) fn narrow(value: f32) -> u16 {
    upper(value) as u16
}

#[inline(always)]
pub(super) fn widen(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}

impl Line {
    /// Makes a line whose blocks are still to be written; what lies before and after them is zero.
    ///
    /// # Safety
    /// Every block must be written before it is read.
    pub(super) unsafe fn unwritten(grid: &Grid, channels: usize) -> Self {
        // SAFETY: the caller's promise.
        let mut values = unsafe { Buffer::unwritten(grid.length() * channels) };
        values[..grid.first() * channels].fill(0);
        values[grid.last() * channels..].fill(0);
        Self { values, channels }
    }

    /// Joins planes, `[images, channels, height, width]` of every input, padded with zero channels to a
    /// multiple of 32.
    pub(super) fn from_planes(grid: &Grid, inputs: &[(&[f32], usize)]) -> Self {
        let all: usize = inputs.iter().map(|(_, channels)| channels).sum();
        let channels = all.next_multiple_of(CHANNELS);
        // SAFETY: pixels are written below, and everything between them here.
        let mut line = unsafe { Self::unwritten(grid, channels) };
        for gap in grid.gaps() {
            line.values[gap.start * channels..gap.end * channels].fill(0);
        }
        let pixels = grid.height * grid.width;
        let to = Shared(line.values.as_mut_ptr());
        let bands = grid.height.div_ceil(BAND_ROWS);
        (0..grid.images * bands).into_par_iter().for_each(|task| {
            let (image, first) = (task / bands, task % bands * BAND_ROWS);
            let rows = first..grid.height.min(first + BAND_ROWS);
            let planes = inputs.iter().flat_map(|&(values, count)| {
                (0..count).map(move |c| &values[(image * count + c) * pixels..][..pixels])
            });
            let planes: Vec<&[f32]> = planes.collect();
            Arch::new().dispatch(Join { grid, image, rows, planes: &planes, channels, to });
        });
        line
    }

    /// Writes `count` channels from `first` on as planes, `[images, count, height, width]`.
    pub(super) fn write_planes(&self, grid: &Grid, first: usize, count: usize, to: &mut [f32]) {
        let pixels = grid.height * grid.width;
        // Parts of whole tiles of channels, if that is possible.
        let part = if count.is_multiple_of(TILE) { TILE } else { count };
        let parts = count / part;
        to.par_chunks_exact_mut(part * pixels).enumerate().for_each(|(number, planes)| {
            let (image, first) = (number / parts, first + number % parts * part);
            Arch::new().dispatch(Separate { grid, image, line: self, first, count: part, planes });
        });
    }
}

/// Writes rows of the planes of an image to a line.
struct Join<'a> {
    grid: &'a Grid,
    image: usize,
    rows: Range<usize>,
    planes: &'a [&'a [f32]],
    channels: usize,
    to: Shared<u16>,
}

impl WithSimd for Join<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { grid, image, rows, planes, channels, to } = self;
        for (block, planes) in planes.chunks(CHANNELS).enumerate() {
            for row in rows.clone() {
                for column in (0..grid.width).step_by(TILE) {
                    let count = TILE.min(grid.width - column);
                    let at = row * grid.width + column;
                    let mut pairs = [[0; TILE]; TILE];
                    for (pair, to) in planes.chunks(2).zip(&mut pairs) {
                        for (to, &low) in to.iter_mut().zip(&pair[0][at..at + count]) {
                            *to = upper(low);
                        }
                        if let Some(high) = pair.get(1) {
                            for (to, &high) in to.iter_mut().zip(&high[at..at + count]) {
                                *to |= upper(high) << 16;
                            }
                        }
                    }
                    let pixels = transposed(&pairs);
                    let place = grid.row(image, row) + column;
                    for (k, pixel) in pixels.iter().enumerate().take(count) {
                        let at = to.at((place + k) * channels + block * CHANNELS);
                        // SAFETY: a pixel's channels, which no other thread writes; the line is long enough.
                        unsafe { at.cast::<[u32; TILE]>().write_unaligned(*pixel) };
                    }
                }
            }
        }
    }
}

/// Writes channels of an image's line to its planes.
struct Separate<'a> {
    grid: &'a Grid,
    image: usize,
    line: &'a Line,
    first: usize,
    count: usize,
    planes: &'a mut [f32],
}

impl WithSimd for Separate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { grid, image, line, first, count, planes } = self;
        let pixels = grid.height * grid.width;
        for channel in (0..count).step_by(TILE) {
            let channels = TILE.min(count - channel);
            for row in 0..grid.height {
                for column in (0..grid.width).step_by(TILE) {
                    let columns = TILE.min(grid.width - column);
                    let mut tile = [[0; TILE]; TILE];
                    for (k, to) in tile.iter_mut().enumerate().take(columns) {
                        let place = grid.row(image, row) + column + k;
                        let at = place * line.channels + first + channel;
                        for (to, &value) in to.iter_mut().zip(&line.values[at..at + channels]) {
                            *to = u32::from(value) << 16;
                        }
                    }
                    let rows = transposed(&tile);
                    for (c, row_of_channel) in rows.iter().enumerate().take(channels) {
                        let at = (channel + c) * pixels + row * grid.width + column;
                        let to = &mut planes[at..at + columns];
                        for (to, &bits) in to.iter_mut().zip(row_of_channel) {
                            *to = f32::from_bits(bits);
                        }
                    }
                }
            }
        }
    }
}
