//! Blocks of consecutive frames around a reference frame, and interpolation of the blocks' motion to single
//! frames.

use crate::patch::PatchMotion;
use std::ops::Range;

/// Consecutive blocks that cover a window.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Blocks {
    pub(crate) ranges: Vec<Range<usize>>,
    /// Index of the block whose middle is the reference frame.
    pub(crate) reference: usize,
}

impl Blocks {
    /// Divides `frames` frames into blocks of `length` frames (odd), one of them around `reference`. Blocks
    /// at the ends may be shorter.
    pub(crate) fn around(reference: usize, frames: usize, length: usize) -> Self {
        let half = length / 2;
        let own = reference.saturating_sub(half)..(reference + half + 1).min(frames);
        let mut before = Vec::new();
        let mut end = own.start;
        while end > 0 {
            let start = end.saturating_sub(length);
            before.push(start..end);
            end = start;
        }
        before.reverse();
        let number = before.len();
        let mut ranges = before;
        let mut start = own.end;
        ranges.push(own);
        while start < frames {
            let end = (start + length).min(frames);
            ranges.push(start..end);
            start = end;
        }
        Self { ranges, reference: number }
    }

    /// Lists the ranges of the blocks, the reference's first.
    pub(crate) fn reference_first(&self) -> impl Iterator<Item = &Range<usize>> {
        let others = (0..self.ranges.len()).filter(|&k| k != self.reference);
        std::iter::once(self.reference).chain(others).map(|k| &self.ranges[k])
    }

    /// Interpolates the motion of every patch to every frame, `[frame][patch]`. It is linear between the
    /// middles of the blocks, and extrapolated beyond them. The reference block's motion is zero at
    /// `reference`.
    pub(crate) fn interpolate(&self, flows: &PatchMotion, reference: usize) -> PatchMotion {
        let middle = |k: usize| {
            let range = &self.ranges[k];
            if k == self.reference {
                reference as f32
            } else {
                0.5 * (range.start + range.end - 1) as f32
            }
        };
        let last = self.ranges.len() - 1;
        let frames = self.ranges[last].end;
        let of_frame = |frame: usize| {
            let time = frame as f32;
            let above = (1..last).find(|&k| middle(k) >= time).unwrap_or(last);
            let below = above.saturating_sub(1);
            if above == below || middle(below) == time {
                return flows[below].clone();
            }
            let part = (time - middle(below)) / (middle(above) - middle(below));
            let between = |(a, b): (&[f32; 2], &[f32; 2])| {
                std::array::from_fn(|k| a[k] + part * (b[k] - a[k]))
            };
            flows[below].iter().zip(&flows[above]).map(between).collect()
        };
        (0..frames).map(of_frame).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covers_the_window_once() {
        for frames in 1..14 {
            for reference in 0..frames {
                for length in [1, 3, 5] {
                    let blocks = Blocks::around(reference, frames, length);
                    let covered: Vec<usize> = blocks.ranges.iter().cloned().flatten().collect();
                    assert_eq!(covered, (0..frames).collect::<Vec<_>>());
                    assert!(blocks.ranges[blocks.reference].contains(&reference));
                }
            }
        }
    }

    #[test]
    fn interpolates_constant_velocity_exactly() {
        for (reference, length) in [(5, 3), (0, 3), (10, 5), (4, 1)] {
            let blocks = Blocks::around(reference, 11, length);
            // 2 pixels per frame, measured at the middles of the blocks.
            let flows: Vec<Vec<[f32; 2]>> = (0..blocks.ranges.len())
                .map(|k| {
                    let range = &blocks.ranges[k];
                    let middle = 0.5 * (range.start + range.end - 1) as f32;
                    let from = if k == blocks.reference { 0.0 } else { middle - reference as f32 };
                    vec![[2.0 * from, -from]]
                })
                .collect();
            for (frame, flow) in blocks.interpolate(&flows, reference).iter().enumerate() {
                let expected = frame as f32 - reference as f32;
                assert!((flow[0][0] - 2.0 * expected).abs() < 1e-4, "{reference} {frame}");
                assert!((flow[0][1] + expected).abs() < 1e-4);
            }
        }
    }
}
