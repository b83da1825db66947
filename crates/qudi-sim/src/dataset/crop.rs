//! A square cut from a frame, turned and mirrored.

use crate::frame::{Frame, Size};

/// Where a sample lies in its frames, and how it is turned.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crop {
    pub(super) left: usize,
    pub(super) top: usize,
    pub(super) side: usize,
    /// One of eight: bit 0 mirrors, bit 1 flips, bit 2 exchanges rows and columns.
    pub(super) turn: u8,
}

impl Crop {
    /// The square of a frame that holds it.
    pub(super) fn of(self, frame: &Frame) -> Frame {
        let last = self.side - 1;
        Frame::from_fn(Size { height: self.side, width: self.side }, |x, y| {
            let (x, y) = if self.turn & 4 == 0 { (x, y) } else { (y, x) };
            let x = if self.turn & 1 == 0 { x } else { last - x };
            let y = if self.turn & 2 == 0 { y } else { last - y };
            frame.data[(self.top + y) * frame.size.width + self.left + x]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eight_turns_differ_and_keep_every_pixel() {
        let size = Size { height: 5, width: 6 };
        let frame = Frame::from_fn(size, |x, y| (10 * y + x) as f32);
        let mut seen = Vec::new();
        for turn in 0..8 {
            let part = Crop { left: 2, top: 1, side: 3, turn }.of(&frame);
            let mut sorted = part.data.clone();
            sorted.sort_by(f32::total_cmp);
            assert_eq!(sorted, [12.0, 13.0, 14.0, 22.0, 23.0, 24.0, 32.0, 33.0, 34.0]);
            assert!(!seen.contains(&part.data));
            seen.push(part.data);
        }
        assert_eq!(seen[0][..3], [12.0, 13.0, 14.0]);
    }
}
