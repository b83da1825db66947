//! Squares cut from frames, turned, mirrored and downscaled.

use super::pack::PackedFrame;
use qudi_core::{Frame, Size};

/// Place of a sample in its frames, and its orientation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crop {
    pub(super) left: usize,
    pub(super) top: usize,
    pub(super) side: usize,
    /// One of eight: bit 0 mirrors, bit 1 flips, bit 2 exchanges rows and columns.
    pub(super) turn: u8,
}

impl Crop {
    /// Returns this square of a frame.
    pub(super) fn of(self, frame: PackedFrame<'_>) -> Frame {
        let last = self.side - 1;
        Frame::from_fn(Size { height: self.side, width: self.side }, |x, y| {
            let (x, y) = if self.turn & 4 == 0 { (x, y) } else { (y, x) };
            let x = if self.turn & 1 == 0 { x } else { last - x };
            let y = if self.turn & 2 == 0 { y } else { last - y };
            frame.value(self.left + x, self.top + y)
        })
    }
}

/// Downscales a picture: means over areas.
pub(super) fn shrunk(picture: Frame, size: Size) -> Frame {
    if size == picture.size {
        return picture;
    }
    let data = shrunk_along_rows(&picture.data, picture.size.width, size.width);
    let data = shrunk_along_rows(&data, picture.size.height, size.height);
    Frame { size, data }
}

/// Downscales rows of a length to another, and transposes the picture.
fn shrunk_along_rows(values: &[f32], long: usize, short: usize) -> Vec<f32> {
    let count = values.len() / long;
    let mut data = vec![0.0; short * count];
    for (y, row) in values.chunks_exact(long).enumerate() {
        for x in 0..short {
            data[x * count + y] = mean(row, x, short);
        }
    }
    data
}

/// Returns the mean over part `x` of `side` equal parts of a row.
fn mean(row: &[f32], x: usize, side: usize) -> f32 {
    let length = row.len() as f32 / side as f32;
    let (from, to) = (x as f32 * length, (x + 1) as f32 * length);
    let first = from as usize;
    let covered = |i: usize| (to.min((i + 1) as f32) - from.max(i as f32)).max(0.0);
    let last = (to.ceil() as usize).min(row.len());
    let sum: f32 = (first..last).map(|i| covered(i) * row[i]).sum();
    sum / (first..last).map(covered).sum::<f32>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smaller_pictures_keep_slopes_means_and_white() {
        let square = |side: usize| Size { height: side, width: side };
        let ramp = |side: usize| {
            let place = |i: usize| (i as f32 + 0.5) / side as f32;
            Frame::from_fn(square(side), |x, y| 0.25 * place(x) + 0.75 * place(y))
        };
        for (long, side) in [(9, 9), (9, 8), (12, 6), (31, 20), (17, 5)] {
            let (small, wanted) = (shrunk(ramp(long), square(side)), ramp(side));
            assert_eq!(small.size, wanted.size);
            // Parts of a step of the ramp count as that step: up to a quarter of it is lost.
            let most = 0.26 / long as f32;
            for (a, b) in small.data.iter().zip(&wanted.data) {
                assert!((a - b).abs() < most, "{long} -> {side}: {a} for {b}");
            }
            assert!((small.mean() - wanted.mean()).abs() < 1e-4);
        }
        let white = Frame::filled(Size { height: 31, width: 47 }, 1.0);
        let small = shrunk(white, Size { height: 19, width: 40 });
        assert_eq!(small.data.len(), 19 * 40);
        assert!(small.data.iter().all(|&value| (value - 1.0).abs() < 1e-6));
    }

    #[test]
    fn eight_turns_differ_and_keep_every_pixel() {
        let size = Size { height: 5, width: 6 };
        let values: Vec<u8> = (0..30).map(|i| 10 * (i / 6) + i % 6).collect();
        let frame = PackedFrame { size, values: &values };
        let mut seen = Vec::new();
        for turn in 0..8 {
            let part = Crop { left: 2, top: 1, side: 3, turn }.of(frame);
            let part: Vec<u8> = part.data.iter().map(|v| (v * 255.0).round() as u8).collect();
            let mut sorted = part.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, [12, 13, 14, 22, 23, 24, 32, 33, 34]);
            assert!(!seen.contains(&part));
            seen.push(part);
        }
        assert_eq!(seen[0][..3], [12, 13, 14]);
    }
}
