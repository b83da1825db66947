//! Repair of hot and dead pixels from their neighbours (Ma et al. 2020, section 7). The known bad pixels of a
//! sensor are masked before; this finds the ones that appear later.

use qudi_core::bad_pixels::BadPixels;
use qudi_core::restorer::BurstView;
use std::borrow::Cow;

/// Bad pixels, each with its good neighbours.
#[derive(Clone, Debug)]
pub(crate) struct HotPixels {
    pixels: Vec<(usize, Vec<usize>)>,
}

impl HotPixels {
    /// Finds bad pixels in the sum of the window.
    pub(crate) fn find(burst: BurstView<'_>, max_count: u16) -> Self {
        let mut sums = vec![0u32; burst.size.pixels()];
        for frame in burst.frames {
            for (sum, &count) in sums.iter_mut().zip(frame) {
                *sum += u32::from(count);
            }
        }
        let size = burst.size;
        let bad = BadPixels::find(&sums, size, burst.frames.len() as u64, Some(max_count));
        let mask = bad.mask(size);
        let good = |i: usize| {
            let (x, y) = (i % size.width, i / size.width);
            let rows = y.saturating_sub(1)..(y + 2).min(size.height);
            let columns = x.saturating_sub(1)..(x + 2).min(size.width);
            rows.flat_map(|row| columns.clone().map(move |column| row * size.width + column))
                .filter(|&j| !mask[j])
                .collect()
        };
        let pixels = bad.hot.iter().chain(&bad.dead).map(|&i| (i, good(i))).collect();
        Self { pixels }
    }

    /// Replaces bad pixels with the mean of their good neighbours.
    pub(crate) fn repaired(&self, counts: &[u16]) -> Vec<f32> {
        let mut repaired: Vec<f32> = counts.iter().map(|&count| f32::from(count)).collect();
        for (i, neighbours) in self.pixels.iter().filter(|(_, good)| !good.is_empty()) {
            let sum: f32 = neighbours.iter().map(|&j| f32::from(counts[j])).sum();
            repaired[*i] = sum / neighbours.len() as f32;
        }
        repaired
    }

    /// Replaces bad pixels with one good neighbour, a different one in every frame, so that the noise stays
    /// the noise of a count.
    pub(crate) fn replaced<'a>(&self, counts: &'a [u16], frame: usize) -> Cow<'a, [u16]> {
        if self.pixels.is_empty() {
            return Cow::Borrowed(counts);
        }
        let mut replaced = counts.to_vec();
        for (i, neighbours) in self.pixels.iter().filter(|(_, good)| !good.is_empty()) {
            replaced[*i] = counts[neighbours[frame % neighbours.len()]];
        }
        Cow::Owned(replaced)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repairs_hot_pixel_from_its_neighbours() {
        let size = qudi_core::Size { height: 12, width: 14 };
        let mut frame = vec![1u16; size.pixels()];
        frame[5 * 14 + 6] = 7;
        let frames = vec![frame.clone(); 11];
        let hot = HotPixels::find(BurstView { size, frames: &frames }, 7);
        assert_eq!(hot.repaired(&frame), vec![1.0; size.pixels()]);
    }
}
