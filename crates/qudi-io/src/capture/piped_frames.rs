//! Broken frames of pipes, which come once: each is judged when it is read.

use super::judge::FrameStatistics;
use qudi_core::Size;
use std::collections::BTreeSet;

/// Counts of a frame after which an empty one is no chance.
const MIN_SUM: u64 = 30;

/// Factor by which the light of a frame at one value exceeds the light of the one before.
const MIN_RISE: f64 = 1.1;

/// Broken frames that are named.
const MAX_NAMED: usize = 5;

/// The last good frame, and the broken ones that were read.
#[derive(Default)]
pub(super) struct PipedFrames {
    last: Vec<u16>,
    sum: u64,
    broken: BTreeSet<u64>,
}

impl PipedFrames {
    /// Judges frame `number`: the good frame before stands in for an empty one, and for one at one value.
    /// Returns a note where it is new.
    pub(super) fn judge(&mut self, number: u64, counts: &mut [u16], size: Size) -> Option<String> {
        let (own, _) = FrameStatistics::of(counts, size);
        let is_empty = own.sum == 0 && self.sum >= MIN_SUM;
        let is_full = own.is_constant && own.sum as f64 > MIN_RISE * self.sum as f64;
        if self.last.len() != counts.len() || !(is_empty || is_full) {
            self.last.clear();
            self.last.extend_from_slice(counts);
            self.sum = own.sum;
            return None;
        }
        counts.copy_from_slice(&self.last);
        let is_new = self.broken.insert(number) && self.broken.len() <= MAX_NAMED;
        let what = if is_empty { "is empty" } else { "has one value" };
        is_new.then(|| format!("frame {number} {what}: the one before stands in"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_frame_before_stands_in_for_broken_ones() {
        let size = Size { height: 8, width: 8 };
        let good = |add: u16| (0..64).map(|i| i % 5 + add).collect::<Vec<u16>>();
        let mut piped = PipedFrames::default();
        let mut notes = Vec::new();
        let mut read = [good(0), vec![65535; 64], good(1), vec![0; 64], good(0), good(0)];
        for (number, frame) in (0..).zip(&mut read) {
            notes.extend(piped.judge(number, frame, size));
        }
        assert_eq!(read, [good(0), good(0), good(1), good(1), good(0), good(0)]);
        assert_eq!(notes.len(), 2, "{notes:?}");
    }
}
