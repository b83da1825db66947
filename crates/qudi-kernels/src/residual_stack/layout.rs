//! Images between planes of 32 bits and lines of bfloat16 with channels last.
#![allow(unsafe_code)]

use super::grid::{Grid, TILE};
use crate::conv::upper;
use rayon::prelude::*;

/// Channels of a block: one row of a tile.
pub(super) const CHANNELS: usize = 32;

/// A line of pixels, bfloat16, channels last. Places that are no pixels are zero.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub(super) values: Vec<u16>,
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
    #[allow(clippy::uninit_vec)]
    pub(super) unsafe fn unwritten(grid: &Grid, channels: usize) -> Self {
        let length = grid.length() * channels;
        let mut values: Vec<u16> = Vec::with_capacity(length);
        // SAFETY: the caller's promise.
        unsafe { values.set_len(length) };
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
        (0..grid.images).into_par_iter().for_each(|image| {
            let planes = inputs.iter().flat_map(|&(values, count)| {
                (0..count).map(move |c| &values[(image * count + c) * pixels..][..pixels])
            });
            let planes: Vec<&[f32]> = planes.collect();
            for (block, planes) in planes.chunks(CHANNELS).enumerate() {
                for row in 0..grid.height {
                    for column in (0..grid.width).step_by(TILE) {
                        let count = TILE.min(grid.width - column);
                        let mut tile = [[0u32; TILE]; TILE];
                        for (pair, tile) in planes.chunks(2).zip(&mut tile) {
                            let at = row * grid.width + column;
                            let low = &pair[0][at..at + count];
                            for (to, &low) in tile.iter_mut().zip(low) {
                                *to = u32::from(narrow(low));
                            }
                            if let Some(high) = pair.get(1) {
                                for (to, &high) in tile.iter_mut().zip(&high[at..at + count]) {
                                    *to |= u32::from(narrow(high)) << 16;
                                }
                            }
                        }
                        let place = grid.row(image, row) + column;
                        for k in 0..count {
                            let at = (place + k) * channels + block * CHANNELS;
                            // SAFETY: a pixel's channels, which no other image has; the line is long enough.
                            let to = unsafe { std::slice::from_raw_parts_mut(to.at(at), CHANNELS) };
                            for (to, row) in to.chunks_exact_mut(2).zip(&tile) {
                                (to[0], to[1]) = (row[k] as u16, (row[k] >> 16) as u16);
                            }
                        }
                    }
                }
            }
        });
        line
    }

    /// Writes `count` channels from `first` on as planes, `[images, count, height, width]`.
    pub(super) fn write_planes(&self, grid: &Grid, first: usize, count: usize, to: &mut [f32]) {
        let pixels = grid.height * grid.width;
        to.par_chunks_exact_mut(count * pixels).enumerate().for_each(|(image, planes)| {
            for channel in (0..count).step_by(TILE) {
                let channels = TILE.min(count - channel);
                for row in 0..grid.height {
                    for column in (0..grid.width).step_by(TILE) {
                        let columns = TILE.min(grid.width - column);
                        let mut tile = [[0.0f32; TILE]; TILE];
                        for k in 0..columns {
                            let place = grid.row(image, row) + column + k;
                            let at = place * self.channels + first + channel;
                            let values = &self.values[at..at + channels];
                            for (tile, &value) in tile.iter_mut().zip(values) {
                                tile[k] = widen(value);
                            }
                        }
                        for (c, tile) in tile.iter().enumerate().take(channels) {
                            let at = (channel + c) * pixels + row * grid.width + column;
                            planes[at..at + columns].copy_from_slice(&tile[..columns]);
                        }
                    }
                }
            }
        });
    }
}
