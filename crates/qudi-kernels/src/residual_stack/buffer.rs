//! Memory for the matrix unit, aligned to lines of the cache: a row of a tile that lies in two of them takes
//! twice as long to load.
#![allow(unsafe_code)]

use std::ops::{Deref, DerefMut};

/// Values of a cache line.
const VALUES: usize = 32;

#[repr(C, align(64))]
#[derive(Clone, Copy, Debug)]
struct CacheLine([u16; VALUES]);

/// Values that begin with a cache line.
#[derive(Clone, Debug, Default)]
pub(super) struct Buffer {
    lines: Vec<CacheLine>,
    length: usize,
}

impl Buffer {
    /// Creates a buffer of zeros.
    pub(super) fn zeros(length: usize) -> Self {
        Self { lines: vec![CacheLine([0; VALUES]); length.div_ceil(VALUES)], length }
    }

    /// Creates a buffer whose values are still to be written.
    ///
    /// # Safety
    /// Every value must be written before it is read.
    #[allow(clippy::uninit_vec)]
    pub(super) unsafe fn unwritten(length: usize) -> Self {
        let mut lines = Vec::with_capacity(length.div_ceil(VALUES));
        // SAFETY: the caller's promise.
        unsafe { lines.set_len(length.div_ceil(VALUES)) };
        Self { lines, length }
    }

    /// Changes the length. The values are arbitrary.
    pub(super) fn resize(&mut self, length: usize) {
        if self.lines.len() < length.div_ceil(VALUES) {
            self.lines.resize(length.div_ceil(VALUES), CacheLine([0; VALUES]));
        }
        self.length = length;
    }

    /// Returns pairs of values as numbers of 32 bits.
    pub(super) fn pairs_mut(&mut self) -> &mut [u32] {
        // SAFETY: the values are aligned to 64 bytes, and any bits are numbers.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.length / 2) }
    }
}

impl Deref for Buffer {
    type Target = [u16];

    fn deref(&self) -> &[u16] {
        // SAFETY: cache lines are values one after the other.
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.length) }
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [u16] {
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.length) }
    }
}
