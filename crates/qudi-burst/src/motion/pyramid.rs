//! Pyramid of a block of frames at the scales of alignment.

use crate::patch::SIDE;
use qudi_core::{Frame, Size};

/// Coarser levels: the shrink factor from the level before, and the side of the patches matched on it.
const COARSE_LEVELS: [(usize, usize); 2] = [(2, SIDE), (4, SIDE / 2)];

/// Smoothed mean counts, finest level first.
#[derive(Clone, Debug)]
pub(crate) struct Pyramid {
    pub(crate) levels: Vec<Level>,
}

/// One scale of a pyramid.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    pub(crate) image: Frame,
    /// Shrink factor from the level before.
    pub(crate) ratio: usize,
    /// Side of its patches; the image is at least that large.
    pub(crate) side: usize,
}

impl Pyramid {
    pub(crate) fn new(counts: &Frame) -> Self {
        let mut levels = vec![Level { image: smooth(counts), ratio: 1, side: SIDE }];
        let mut image = counts.clone();
        for (ratio, side) in COARSE_LEVELS {
            let size = Size { height: image.size.height / ratio, width: image.size.width / ratio };
            if size.height.min(size.width) < side {
                break;
            }
            image = shrink(&image, size, ratio);
            levels.push(Level { image: smooth(&image), ratio, side });
        }
        Self { levels }
    }
}

/// Averages squares of `ratio` x `ratio` pixels.
pub(crate) fn shrink(image: &Frame, size: Size, ratio: usize) -> Frame {
    let scale = 1.0 / (ratio * ratio) as f32;
    Frame::from_fn(size, |x, y| {
        let rows = (y * ratio..(y + 1) * ratio).map(|row| image.row(row));
        let sum: f32 = rows.map(|row| row[x * ratio..(x + 1) * ratio].iter().sum::<f32>()).sum();
        sum * scale
    })
}

/// Applies the binomial filter 1 4 6 4 1 along both axes, with borders repeated. Without it, single photons
/// would be matched.
pub(crate) fn smooth(image: &Frame) -> Frame {
    const TAPS: [f32; 5] = [0.0625, 0.25, 0.375, 0.25, 0.0625];
    let Size { height, width } = image.size;
    let filtered = |source: &Frame, step: [usize; 2]| {
        Frame::from_fn(image.size, |x, y| {
            let tap = |(k, weight): (usize, &f32)| {
                let x = (x + k * step[0]).saturating_sub(2 * step[0]).min(width - 1);
                let y = (y + k * step[1]).saturating_sub(2 * step[1]).min(height - 1);
                weight * source.data[y * width + x]
            };
            TAPS.iter().enumerate().map(tap).sum()
        })
    };
    filtered(&filtered(image, [1, 0]), [0, 1])
}
