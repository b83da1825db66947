//! Aligned sums: long exposures for bursts longer than a method's window.
//!
//! In low light, quanta burst photography merges hundreds of frames. It aligns blocks of frames and shifts
//! each frame along the motion between blocks (Ma et al. 2020, sections 5.1 and 5.2). Here a method restores
//! its usual window of frames, but each frame is the sum of many captured frames, shifted by whole pixels.
//! Whole-pixel shifts keep the counts integer, with the distribution of the sensor's own sums.

mod choice;
mod motion;

pub use choice::choose_count;

use motion::BlockMotion;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Frame, Result};
use std::fmt;

/// A method that restores aligned sums of frames instead of single frames.
pub struct AlignedSums {
    method: Box<dyn Restorer>,
    count: usize,
    block: usize,
}

impl fmt::Debug for AlignedSums {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut debug = f.debug_struct("AlignedSums");
        debug.field("method", &self.method.name()).field("count", &self.count);
        debug.field("block", &self.block).finish()
    }
}

impl AlignedSums {
    /// Creates a method that restores sums of `count` frames, aligned along the motion between sums of
    /// `block` frames.
    pub fn new(method: Box<dyn Restorer>, count: usize, block: usize) -> Self {
        Self { method, count: count.max(1), block: block.max(1) }
    }

    /// Returns the acquisition of sums of `count` frames.
    ///
    /// # Errors
    /// [`Error::Request`] if sums do not fit into 16 bits.
    pub fn acquisition(acquisition: &Acquisition, count: usize) -> Result<Acquisition> {
        let mut of_sums = acquisition.clone();
        let frames = u64::from(acquisition.sensor.frames_summed) * count as u64;
        if frames > u64::from(u16::MAX) {
            let what = format!("sums of {frames} frames");
            return Err(Error::request(what, "sum", "sums hold 16 bits: add fewer"));
        }
        of_sums.sensor.frames_summed = frames as u32;
        of_sums.ppp *= count as f64;
        // A shifted sum mixes the dark counts of many pixels, so there is no dark map for it.
        of_sums.dark = None;
        Ok(of_sums)
    }
}

impl Restorer for AlignedSums {
    fn name(&self) -> &'static str {
        self.method.name()
    }

    fn window(&self) -> usize {
        self.method.window() * self.count
    }

    /// Frames whose distance is a multiple of `count` are restored together, so that their sums share no
    /// counts.
    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        let count = self.count.min(burst.frames.len());
        let of_sums = Self::acquisition(acquisition, count)?;
        let motion = BlockMotion::find(burst, acquisition, self.block)?;
        let mut frames: Vec<Option<Frame>> = vec![None; numbers.len()];
        let mut std = frames.clone();
        for pass in 0..count {
            let places: Vec<usize> =
                (0..numbers.len()).filter(|&place| numbers[place] % count == pass).collect();
            if places.is_empty() {
                continue;
            }
            let sums = motion.sums(pass, count);
            let view = BurstView { size: burst.size, frames: &sums };
            let of_pass: Vec<usize> = places.iter().map(|&place| numbers[place] / count).collect();
            let restored = self.method.restore_frames(view, &of_sums, &of_pass)?;
            for (&place, frame) in places.iter().zip(restored.frames) {
                frames[place] = Some(frame);
            }
            for (&place, sigma) in places.iter().zip(restored.std.into_iter().flatten()) {
                std[place] = Some(sigma);
            }
        }
        let frames = frames.into_iter().flatten().collect();
        Ok(Restored::gray(frames, std.into_iter().collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::{Average, PostFilter, Qbp};
    use qudi_core::metrics::gain_aligned_psnr;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light, Size};

    const SIZE: Size = Size { height: 64, width: 80 };

    /// Exposes binary frames of a texture that moves by `speed` pixels per frame. Returns the frames, their
    /// acquisition and the scene at frame `middle`.
    fn burst(frames: usize, speed: f32, middle: usize) -> (Vec<Vec<u16>>, Acquisition, Frame) {
        let scene = |t: usize| {
            Frame::from_fn(SIZE, |x, y| {
                let (x, y) = (x as f32 - speed * t as f32, y as f32);
                0.45 + 0.15 * (0.5 * x + 0.2 * y).sin() + 0.15 * (0.35 * y - 0.3 * x).sin()
            })
        };
        let sensor = Sensor::load("swissspad2").unwrap();
        let light = Light { ppp: 1.0, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, SIZE, light, 5).unwrap();
        let counts = (0..frames).map(|t| camera.expose(t as u64, &[&scene(t)]).unwrap()).collect();
        (counts, Acquisition::new(sensor, light.ppp, 0.45).unwrap(), scene(middle))
    }

    #[test]
    fn long_bursts_of_moving_scenes_show_more() {
        let (counts, acquisition, truth) = burst(330, 0.15, 165);
        let quality = |method: &mut dyn Restorer, first: usize, length: usize| {
            let view = BurstView { size: SIZE, frames: &counts[first..first + length] };
            let restored = method.restore_frames(view, &acquisition, &[165 - first]).unwrap();
            gain_aligned_psnr(&restored.frames[0], &truth)
        };
        let qbp = || Box::new(Qbp::new(PostFilter::None));
        let short = quality(qbp().as_mut(), 160, 11);
        let long = quality(&mut AlignedSums::new(qbp(), 30, 15), 0, 330);
        // 30 times the light reduces the noise by 14.8 dB.
        assert!(long > short + 6.0, "{short} {long}");
    }

    #[test]
    fn selected_frames_equal_those_of_the_whole_window() {
        let (counts, acquisition, _) = burst(40, 0.1, 0);
        let view = BurstView { size: SIZE, frames: &counts };
        let mut aligned = AlignedSums::new(Box::new(Average), 3, 3);
        let all = aligned.restore(view, &acquisition).unwrap().frames;
        let some = aligned.restore_frames(view, &acquisition, &[5, 7, 38]).unwrap().frames;
        assert_eq!(some, [5, 7, 38].map(|n: usize| all[n].clone()));
        assert_eq!(all.len(), 40);
    }

    #[test]
    fn sums_beyond_16_bits_are_refused() {
        let (counts, acquisition, _) = burst(3, 0.0, 0);
        let view = BurstView { size: SIZE, frames: &counts };
        let sensor = Sensor { frames_summed: 40_000, ..acquisition.sensor.clone() };
        let acquisition = Acquisition { sensor, ..acquisition };
        let mut aligned = AlignedSums::new(Box::new(Average), 2, 1);
        assert!(aligned.restore(view, &acquisition).is_err());
    }
}
