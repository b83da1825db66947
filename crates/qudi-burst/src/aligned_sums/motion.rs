//! Motion of a burst between blocks of frames, and sums of frames along it.

use super::AlignedSums;
use crate::merge::hot_pixels::HotPixels;
use crate::motion::constant_velocity::ConstantVelocity;
use crate::prepared_burst::PreparedBurst;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Result, Size};
use rayon::prelude::*;
use std::borrow::Cow;

/// Blocks in a stretch of constant velocity.
const STRETCH_BLOCKS: usize = 2 * LONGEST_HALF + 1;

/// Log-likelihood, in nats, by which a velocity must fit better than rest or the global velocity. Among the
/// many velocities tried, some fit well by chance.
const EVIDENCE_THRESHOLD: f32 = 6.0;

/// Counts of a burst and the velocity of each patch in each block of frames.
#[derive(Debug)]
pub(super) struct BlockMotion<'a> {
    size: Size,
    counts: Vec<Cow<'a, [u16]>>,
    /// Frames per block.
    block: usize,
    /// Velocity in pixels per frame, `[block][patch]`.
    velocities: Vec<Vec<[f32; 2]>>,
    /// Index of the patch of each pixel.
    patch: Vec<u32>,
}

impl<'a> BlockMotion<'a> {
    /// Finds the velocities between sums of `block` frames.
    pub(super) fn find(
        burst: BurstView<'a>,
        acquisition: &Acquisition,
        block: usize,
    ) -> Result<Self> {
        let hot = HotPixels::find(burst, acquisition.sensor.max_count());
        let counts: Vec<Cow<'a, [u16]>> =
            (0..).zip(burst.frames).map(|(n, counts)| hot.replaced(counts, n)).collect();
        let block = block.min(counts.len());
        let blocks: Vec<Vec<u16>> = counts.par_chunks_exact(block).map(plain_sum).collect();
        let of_blocks = AlignedSums::acquisition(acquisition, block)?;
        let mut motion = Self {
            size: burst.size,
            counts,
            block,
            velocities: Vec::with_capacity(blocks.len()),
            patch: Vec::new(),
        };
        while motion.velocities.len() < blocks.len() {
            let done = motion.velocities.len();
            let end = (done + STRETCH_BLOCKS).min(blocks.len());
            let first = end.saturating_sub(STRETCH_BLOCKS);
            let view = BurstView { size: burst.size, frames: &blocks[first..end] };
            motion.add_stretch(&PreparedBurst::new(view, &of_blocks), done - first);
        }
        Ok(motion)
    }

    /// Appends the velocities of the blocks of `stretch`, starting with block `first`.
    fn add_stretch(&mut self, stretch: &PreparedBurst, first: usize) {
        let grid = &stretch.grid;
        if self.patch.is_empty() {
            let width = self.size.width;
            let place = |i: usize| [i % width, i / width].map(|at| at as f32);
            self.patch = (0..self.size.pixels()).map(|i| grid.around(place(i))[0] as u32).collect();
        }
        let found = ConstantVelocity::find(stretch, EVIDENCE_THRESHOLD);
        let frames = self.block as f32;
        for number in first..stretch.frames.len() {
            self.velocities.push(match &found {
                Some(found) => {
                    found.velocities(number).iter().map(|v| v.map(|v| v / frames)).collect()
                }
                None => vec![[0.0; 2]; grid.len()],
            });
        }
    }

    /// Returns sums of `count` frames around every `count`th frame, starting with frame `first`.
    pub(super) fn sums(&self, first: usize, count: usize) -> Vec<Vec<u16>> {
        let frames = self.counts.len();
        let middles: Vec<usize> = (first..frames).step_by(count).collect();
        let sum = |&middle: &usize| {
            let from = middle.saturating_sub(count / 2).min(frames - count);
            self.sum(middle, from..from + count)
        };
        middles.par_iter().map(sum).collect()
    }

    /// Sums groups of `count` of the frames `kept`, up to [`STRETCH_BLOCKS`] groups, one of them around frame
    /// `middle`. Returns the sums and the index of that group.
    pub(super) fn sums_of(
        &self,
        kept: &[usize],
        middle: usize,
        count: usize,
    ) -> (Vec<Vec<u16>>, usize) {
        let start = kept.partition_point(|&frame| frame < middle).saturating_sub(count / 2);
        let before = (start / count).min(STRETCH_BLOCKS / 2);
        let first = start - before * count;
        let groups: Vec<&[usize]> =
            kept[first..].chunks_exact(count).take(STRETCH_BLOCKS).collect();
        let sum = |(number, group): (usize, &&[usize])| {
            let at = if number == before { middle } else { group[count / 2] };
            self.sum(at, group.iter().copied())
        };
        (groups.par_iter().enumerate().map(sum).collect(), before)
    }

    /// Sums the given frames, each shifted onto frame `middle`.
    pub(super) fn sum(&self, middle: usize, frames: impl IntoIterator<Item = usize>) -> Vec<u16> {
        let Size { height, width } = self.size;
        let velocities = &self.velocities[(middle / self.block).min(self.velocities.len() - 1)];
        let mut sum = vec![0u16; self.size.pixels()];
        for frame in frames {
            let time = frame as f32 - middle as f32;
            let shifts: Vec<[isize; 2]> =
                velocities.iter().map(|v| v.map(|v| (v * time).round() as isize)).collect();
            let counts = &self.counts[frame];
            for (i, sum) in sum.iter_mut().enumerate() {
                let [dx, dy] = shifts[self.patch[i] as usize];
                let x = ((i % width) as isize + dx).clamp(0, width as isize - 1) as usize;
                let y = ((i / width) as isize + dy).clamp(0, height as isize - 1) as usize;
                *sum = sum.saturating_add(counts[y * width + x]);
            }
        }
        sum
    }
}

/// Sums frames without alignment.
fn plain_sum(frames: &[Cow<'_, [u16]>]) -> Vec<u16> {
    let mut sum = frames[0].to_vec();
    for frame in &frames[1..] {
        sum.iter_mut().zip(frame.iter()).for_each(|(sum, &count)| *sum = sum.saturating_add(count));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::Sensor;

    /// Checks that a bright bar moving by a pixel every two frames stays in place in the sums.
    #[test]
    fn sums_follow_what_moves() {
        let size = Size { height: 48, width: 96 };
        let bar = |t: usize, x: usize| x >= 20 + t / 2 && x < 36 + t / 2;
        let frames: Vec<Vec<u16>> = (0..44)
            .map(|t| {
                let lit = |i: usize| bar(t, i % size.width) || (i / size.width) % 7 == t % 7;
                (0..size.pixels()).map(|i| u16::from(lit(i))).collect()
            })
            .collect();
        let sensor = Sensor::load("swissspad2").unwrap();
        let acquisition = Acquisition::new(sensor, 1.0, 0.45).unwrap();
        let view = BurstView { size, frames: &frames };
        let motion = BlockMotion::find(view, &acquisition, 4).unwrap();
        let sum = motion.sum(22, 14..31);
        let row = &sum[24 * size.width..25 * size.width];
        for (x, &count) in row.iter().enumerate() {
            if x > 33 && x < 45 {
                assert!(count >= 16, "inside at {x}: {count}");
            } else if !(27..=52).contains(&x) {
                assert!(count <= 4, "outside at {x}: {count}");
            }
        }
    }
}
