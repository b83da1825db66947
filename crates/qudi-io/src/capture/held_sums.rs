//! Sums of frames that are held, since restoring reads them several times.

use std::collections::HashMap;

/// Bytes that are held at most.
const MAX_BYTES: usize = 64 << 20;

/// Sums of stored frames, by the number of the first one; all of equally many frames.
#[derive(Default)]
pub(super) struct HeldSums {
    sums: HashMap<u64, Vec<u16>>,
    bytes: usize,
}

impl HeldSums {
    /// Writes the sums that begin with frame `first` into `sums`; returns false if they are not held.
    pub(super) fn copy(&self, first: u64, sums: &mut [u32]) -> bool {
        let Some(held) = self.sums.get(&first) else { return false };
        sums.iter_mut().zip(held).for_each(|(sum, &held)| *sum = held.into());
        true
    }

    /// Holds sums, if they fit.
    pub(super) fn hold(&mut self, first: u64, sums: &[u32]) {
        let bytes = 2 * sums.len();
        if self.bytes + bytes > MAX_BYTES || sums.iter().any(|&sum| sum > u16::MAX.into()) {
            return;
        }
        self.bytes += bytes;
        self.sums.insert(first, sums.iter().map(|&sum| sum as u16).collect());
    }

    /// Forgets all sums.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}
