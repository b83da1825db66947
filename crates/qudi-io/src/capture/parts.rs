//! Parts of a capture between cuts and steps of the light. No sum reaches over their ends, and whatever works
//! with several frames works in one part.

use super::Capture;
use std::ops::Range;

impl Capture {
    /// Returns the parts between cuts and steps of the light: native frames, counted from the first in use.
    pub fn parts(&self) -> Vec<Range<u64>> {
        let Range { start, end } = self.range;
        let inner = self.boundaries.iter().copied().filter(|at| (start + 1..end).contains(at));
        let edges: Vec<u64> = [start].into_iter().chain(inner).chain([end]).collect();
        edges.windows(2).map(|edge| edge[0] - start..edge[1] - start).collect()
    }

    /// Divides the capture into the parts of another, of the same frames.
    #[must_use]
    pub fn divided_as(mut self, other: &Self) -> Self {
        self.boundaries.clone_from(&other.boundaries);
        self
    }

    /// Returns the longest part.
    pub fn longest_part(&self) -> Range<u64> {
        self.parts().into_iter().max_by_key(|part| part.end - part.start).unwrap_or_default()
    }

    /// Does `work` with one of the parts, as if it were all of the capture.
    pub fn in_part<T>(&mut self, part: &Range<u64>, work: impl FnOnce(&mut Self) -> T) -> T {
        if *part == (0..self.native_frames()) {
            return work(self);
        }
        let first = self.range.start;
        let part = first + part.start..first + part.end;
        let end = self.end.replace(part.end);
        let range = std::mem::replace(&mut self.range, part);
        let done = work(self);
        (self.range, self.end) = (range, end);
        done
    }

    /// Returns the number of sums that fit into the parts.
    pub(super) fn sums(&self) -> u64 {
        let sum = u64::from(self.sum);
        if self.boundaries.is_empty() {
            return self.native_frames() / sum;
        }
        self.parts().iter().map(|part| (part.end - part.start) / sum).sum()
    }

    /// Returns the native frame, counted from the first in use, with which output frame `frame` begins.
    pub(super) fn begins(&self, mut frame: u64) -> u64 {
        let sum = u64::from(self.sum);
        if self.boundaries.is_empty() {
            return frame * sum;
        }
        for part in self.parts() {
            let here = (part.end - part.start) / sum;
            if frame < here {
                return part.start + frame * sum;
            }
            frame -= here;
        }
        self.native_frames()
    }
}
