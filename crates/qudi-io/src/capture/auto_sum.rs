//! The number of frames to sum: as many as motion allows, until the light suffices.
//!
//! The speed of a scene shows in how much two neighbouring sums differ beyond their noise, compared with the
//! gradients of the picture: a shift by `d` changes it by `d` times its gradient (Lucas and Kanade 1981).
//! Both are sums over all pixels of products of independent counts, so that noise leaves no bias.

use super::Capture;
use qudi_core::{Result, Size};
use serde::Serialize;

/// Detections per pixel and sum beyond which more light is not worth the loss of frame rate.
pub const SUFFICIENT_DETECTIONS: f64 = 20.0;

/// Factor of the best sum, `FACTOR * motion^-0.6 * detections^-0.4` frames: noise falls with a power of the
/// light, and blur grows with one of the motion. Fitted to simulated captures (docs/notes/burst/sums.md).
const FACTOR: f64 = 0.455;
const MOTION_POWER: f64 = -0.6;
const LIGHT_POWER: f64 = -0.4;

/// Sums that methods restore together.
const WINDOW: u64 = 11;

/// Places of the capture that are sampled.
const SAMPLED_PLACES: u64 = 6;

/// Standard errors beyond which two sums differ.
const Z_SCORE_THRESHOLD: f64 = 6.0;

/// Side of the tiles whose scatter gives the standard error.
const TILE: usize = 32;

/// A number of frames to sum, and the reason.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SumChoice {
    /// Native frames summed into one.
    pub frames: u32,
    /// Detections per pixel and native frame.
    pub detections: f64,
    /// Pixels that the scene moves per native frame; an upper bound if no motion is seen.
    pub motion: f64,
    /// True if no motion is seen.
    pub still: bool,
    /// Limit of the sum.
    pub limit: SumLimit,
}

/// The limit of a sum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SumLimit {
    /// The light suffices.
    Light,
    /// More frames would blur what moves.
    Motion,
    /// Fewer than a window of sums would remain.
    Length,
}

impl SumChoice {
    /// Describes the choice in a sentence, without the frame rate.
    pub fn reason(&self) -> String {
        let detections = f64::from(self.frames) * self.detections;
        let motion = f64::from(self.frames) * self.motion;
        let still = if self.still { "at most " } else { "" };
        let light = format!("{detections:.2} detections per pixel");
        match self.limit {
            SumLimit::Light => format!("{light} are enough"),
            SumLimit::Motion => {
                format!("{light}; the scene moves {still}{motion:.1} pixels meanwhile")
            }
            SumLimit::Length => format!("{light}; {WINDOW} sums are restored together"),
        }
    }
}

/// Chooses how many native frames of `capture` to sum. `None` where sums do not apply: the depth is unknown,
/// frames count photons in more than 4 bits, or are not binary.
///
/// # Errors
/// [`Error`](qudi_core::Error) if the capture cannot be read.
pub fn choose_sum(capture: &mut Capture) -> Result<Option<SumChoice>> {
    let max_count = match capture.info().max_count {
        Some(max_count) if capture.info().binary && max_count <= 15 => max_count,
        _ => return Ok(None),
    };
    debug_assert_eq!(capture.summed(), 1);
    let frames = capture.frames();
    let mut look = Look { capture, max_count };
    let detections = look.detections()?;
    if detections <= 0.0 {
        return Ok(None);
    }
    let (motion, still) = look.motion(detections)?;
    let of_light = (SUFFICIENT_DETECTIONS / detections).ceil();
    let of_motion = FACTOR * motion.powf(MOTION_POWER) * detections.powf(LIGHT_POWER);
    let of_motion = if still { f64::INFINITY } else { of_motion.round() };
    let of_length = (frames / WINDOW) as f64;
    let most = of_light.min(of_motion).min(of_length);
    let limit = if most >= of_light {
        SumLimit::Light
    } else if most >= of_length {
        SumLimit::Length
    } else {
        SumLimit::Motion
    };
    // Sums are held in 16 bits.
    let largest = f64::from(u16::MAX / max_count);
    let frames = most.clamp(1.0, largest) as u32;
    Ok(Some(SumChoice { frames, detections, motion, still, limit }))
}

struct Look<'a> {
    capture: &'a mut Capture,
    max_count: u16,
}

/// Sums over pixels, with their scatter between tiles.
#[derive(Clone, Copy, Debug, Default)]
struct Energy {
    /// Squared differences beyond noise.
    difference: f64,
    /// Standard error of the difference.
    error: f64,
    /// Squared gradients.
    gradient: f64,
}

impl Look<'_> {
    /// Measures the mean detections per pixel and native frame, with the response inverted.
    fn detections(&mut self) -> Result<f64> {
        let sampled = self.capture.sample_frames();
        let mut sums = vec![0u32; self.capture.size().pixels()];
        let mut one = vec![0u32; sums.len()];
        for &frame in &sampled {
            self.capture.total(frame..frame + 1, &mut one)?;
            sums.iter_mut().zip(&one).for_each(|(sum, one)| *sum += one);
        }
        let trials = sampled.len() as f64 * f64::from(self.max_count);
        let rate = |&sum: &u32| -(-f64::from(sum).min(trials - 0.5) / trials).ln_1p();
        let total: f64 = sums.iter().map(rate).sum();
        Ok(total / sums.len() as f64 * f64::from(self.max_count))
    }

    /// Measures the motion in pixels per native frame; the second value is true if it is only a bound.
    fn motion(&mut self, detections: f64) -> Result<(f64, bool)> {
        let frames = self.capture.frames();
        let longest =
            (frames / 2).min((8.0 * SUFFICIENT_DETECTIONS / detections).ceil() as u64).max(1);
        // Below a tenth of a detection a sum shows nothing anyway.
        let mut length = ((0.1 / detections).floor() as u64).clamp(1, longest);
        loop {
            let Energy { difference, error, gradient } = self.energy(length)?;
            let pixels = |energy: f64| (2.0 * energy.max(0.0) / gradient).sqrt() / length as f64;
            let sure = difference > Z_SCORE_THRESHOLD * error && gradient > 0.0;
            if sure || length == longest {
                let moves = if sure { difference } else { difference.max(0.0) + 2.0 * error };
                let motion = if gradient > 0.0 { pixels(moves) } else { 0.0 };
                return Ok((motion, !sure));
            }
            length = (2 * length).min(longest);
        }
    }

    /// Measures how neighbouring sums of `length` frames differ, at some places of the capture.
    fn energy(&mut self, length: u64) -> Result<Energy> {
        let size = self.capture.size();
        let frames = self.capture.frames();
        let room = frames - (2 * length).min(frames);
        let places = if self.capture.forward_only() { 1 } else { SAMPLED_PLACES.min(room + 1) };
        let mut sums = [vec![0u32; size.pixels()], vec![0u32; size.pixels()]];
        let mut tiles = Vec::new();
        let mut gradient = 0.0;
        for place in 0..places {
            let first = room * place / (places - 1).max(1);
            for (half, sums) in sums.iter_mut().enumerate() {
                let start = first + half as u64 * length;
                self.capture.total(start..(start + length).min(frames), sums)?;
            }
            let trials = length as f64 * f64::from(self.max_count);
            gradient += add_place(&sums, size, trials, &mut tiles);
        }
        let n = tiles.len() as f64;
        let difference: f64 = tiles.iter().sum();
        let mean = difference / n;
        let variance = tiles.iter().map(|tile| (tile - mean).powi(2)).sum::<f64>();
        Ok(Energy { difference, error: variance.sqrt(), gradient })
    }
}

/// Adds the energy of the difference of each tile, noise subtracted, and returns the energy of the gradient.
fn add_place(sums: &[Vec<u32>; 2], size: Size, trials: f64, tiles: &mut Vec<f64>) -> f64 {
    let value = |half: usize, x: usize, y: usize| f64::from(sums[half][y * size.width + x]);
    // Unbiased variance of a binomial count; of a single trial nothing but its mean is known.
    let noise = |half: usize, x: usize, y: usize| {
        let count = value(half, x, y);
        if trials > 1.5 { count * (trials - count) / (trials - 1.0) } else { count }
    };
    let mut gradient = 0.0;
    for top in (0..size.height).step_by(TILE) {
        for left in (0..size.width).step_by(TILE) {
            let mut energy = 0.0;
            for y in top..(top + TILE).min(size.height) {
                for x in left..(left + TILE).min(size.width) {
                    let difference = value(0, x, y) - value(1, x, y);
                    energy += difference * difference - noise(0, x, y) - noise(1, x, y);
                    if (1..size.width.saturating_sub(1)).contains(&x)
                        && (1..size.height.saturating_sub(1)).contains(&y)
                    {
                        let [a, b] = [0, 1].map(|half| {
                            let across = value(half, x + 1, y) - value(half, x - 1, y);
                            let down = value(half, x, y + 1) - value(half, x, y - 1);
                            [0.5 * across, 0.5 * down]
                        });
                        gradient += a[0] * b[0] + a[1] * b[1];
                    }
                }
            }
            tiles.push(energy);
        }
    }
    gradient
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};
    use qudi_core::sensor::Sensor;

    const SIZE: Size = Size { height: 64, width: 96 };

    /// Makes binary frames of texture that moves by `speed` pixels a frame.
    fn capture(frames: u64, detections: f64, speed: f64) -> Capture {
        let sensor = Sensor::load("swissspad2").unwrap();
        let light = |x: f64, y: f64| {
            1.0 + 0.5 * (0.5 * x).sin() * (0.4 * y).cos() + 0.3 * (0.9 * x + 0.3 * y).sin()
        };
        let mut rng = Streams::new(7).row(Domain::Photons, 0, 0);
        let frames = (0..frames).map(|t| {
            (0..SIZE.pixels())
                .map(|i| {
                    let (x, y) = ((i % SIZE.width) as f64, (i / SIZE.width) as f64);
                    let rate = detections * light(x - speed * t as f64, y);
                    u16::from(uniform(&mut rng) < -(-rate).exp_m1())
                })
                .collect()
        });
        Capture::in_memory("scene", SIZE, frames.collect(), &sensor).unwrap()
    }

    fn chosen(frames: u64, detections: f64, speed: f64) -> SumChoice {
        choose_sum(&mut capture(frames, detections, speed)).unwrap().unwrap()
    }

    #[test]
    fn measures_light_and_motion() {
        for (detections, speed) in [(0.5, 0.4), (0.1, 0.1), (0.1, 0.02)] {
            let choice = chosen(400, detections, speed);
            let light = choice.detections / detections;
            let motion = choice.motion / speed;
            assert!((0.95..1.05).contains(&light), "{light} at {detections}");
            assert!(!choice.still && (0.5..2.2).contains(&motion), "{motion} at {speed}");
            assert_ne!(choice.limit, SumLimit::Light, "{choice:?}");
        }
    }

    #[test]
    fn sums_still_scenes_until_the_light_is_enough() {
        let bright = chosen(600, 0.5, 0.0);
        assert_eq!((bright.limit, bright.frames), (SumLimit::Light, 40), "{bright:?}");
        let dim = chosen(220, 0.05, 0.0);
        assert_eq!((dim.limit, dim.frames), (SumLimit::Length, 20), "{dim:?}");
        assert!(dim.still);
        let short = chosen(9, 0.05, 0.0);
        assert_eq!(short.frames, 1);
    }

    #[test]
    fn sums_nothing_that_is_dark_or_of_many_bits() {
        assert_eq!(choose_sum(&mut capture(20, 0.0, 0.0)).unwrap(), None);
        let sensor = Sensor { frames_summed: 100, ..Sensor::load("swissspad2").unwrap() };
        let frames = vec![vec![3; SIZE.pixels()]; 20];
        let mut deep = Capture::in_memory("deep", SIZE, frames, &sensor).unwrap();
        assert_eq!(choose_sum(&mut deep).unwrap(), None);
    }
}
