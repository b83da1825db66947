//! Sums that are aligned by themselves: where motion keeps sums short, several of them are added along it.

use crate::error::Result;
use crate::methods::Method;
use qudi_burst::{AlignedSums, choose_count};
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::windows::LONGEST_HALF;
use qudi_io::capture::{Capture, ENOUGH, ReadOptions, SumChoice, SumLimit};
use qudi_io::restore::Instants;

/// Pixels that may move within the sums that are shifted.
const FINE: f64 = 0.5;

/// Detections per pixel of a block, enough for its motion to be found.
const FOUND: f64 = 1.5;

/// Pixels that may move from one block to the next.
const FASTEST: f64 = 6.0;

/// Picture distances of which an aligned sum may consist. One is no alignment.
const MULTIPLES: [usize; 8] = [1, 2, 3, 5, 8, 12, 18, 27];

/// Fine sums in a picture distance, where it has that many frames, and in an aligned sum: few enough are held back
/// to choose by, and lengths are met well enough.
const STEPS: f64 = 8.0;

/// Side of the part of the picture that is looked at.
const SIDE: usize = 160;

/// Blocks along which motion is taken for even, and sums that methods restore together.
const WINDOW: usize = 2 * LONGEST_HALF + 1;

/// Native frames of a sum, at most: sums hold 16 bits.
const LONGEST: u32 = 60_000;

/// Bytes of the counts of a window, at most.
const WINDOW_BYTES: u64 = 256 << 20;

/// Stretches of the capture that are looked at.
const PLACES: u64 = 4;

/// How the fine sums of a capture, read as its frames, are aligned.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Alignment {
    /// Native frames in a fine sum.
    fine: u32,
    /// Fine sums from one picture to the next.
    step: u64,
    /// Fine sums in a block.
    block: usize,
    /// Fine sums in an aligned one.
    pub(crate) count: usize,
}

/// Native frames in an aligned sum, and in the blocks between which motion is found.
#[derive(Clone, Copy, Debug)]
struct Lengths {
    sum: f64,
    block: f64,
}

impl Alignment {
    /// `lengths` in fine sums of a capture that moves by `motion` pixels a native frame, for a picture every
    /// `distance` native frames. Where sums are longer than that, they are multiples of it: pictures whose
    /// distance is a multiple of a sum are restored together.
    fn new(lengths: Lengths, motion: f64, distance: u32) -> Self {
        let slow = |fine: &u32| {
            f64::from(*fine) * motion <= FINE && STEPS * f64::from(*fine) <= lengths.sum
        };
        let divides = |fine: &u32| distance.is_multiple_of(*fine);
        let fine = (1..=distance.min(LONGEST)).rev().filter(divides).find(slow).unwrap_or(1);
        let step = (distance / fine) as usize;
        let of = |native: f64| ((native / f64::from(fine)).round() as usize).max(1);
        let mut count = of(lengths.sum);
        if count > step {
            count = (count + step / 2) / step * step;
        }
        Self { fine, step: step as u64, block: of(lengths.block), count }
    }

    /// The pictures that are made.
    pub(crate) fn instants(self) -> Instants {
        let sum = u64::from(self.fine);
        Instants::Frames { every: self.step * sum, sum }
    }

    /// Native frames in an aligned sum.
    pub(crate) fn native_frames(self) -> u64 {
        self.count as u64 * u64::from(self.fine)
    }

    /// Fine sums from one picture to the next.
    pub(crate) fn step(self) -> u64 {
        self.step
    }

    /// `method`, which sees aligned sums.
    pub(crate) fn around(self, method: Box<dyn Restorer>) -> Box<dyn Restorer> {
        Box::new(AlignedSums::new(method, self.count, self.block))
    }

    /// The acquisition of what the method sees.
    pub(crate) fn acquisition(self, acquisition: &Acquisition) -> Result<Acquisition> {
        Ok(AlignedSums::acquisition(acquisition, self.count)?)
    }

    /// What is aligned, in a sentence.
    pub(crate) fn describe(self) -> String {
        format!(
            "motion is followed: each picture is restored from {WINDOW} sums of {} frames, aligned along it; --sum N adds plain sums instead",
            self.native_frames()
        )
    }
}

/// Finds out whether sums of `capture`, which motion keeps short, can be aligned for `method`, with a picture for
/// every `every` native frames or every sum. If so, its frames become the fine sums that are shifted.
pub(crate) fn align_by_itself(
    capture: Capture,
    choice: &SumChoice,
    method: Option<&Method>,
    every: Option<u64>,
    options: &ReadOptions,
    sensor: &Sensor,
) -> Result<(Capture, Option<Alignment>)> {
    let readable = capture.length().is_some() && !capture.forward_only();
    let aligns = method.is_none_or(|method| method.aligns);
    let known = sensor.dark_per_frame().is_ok();
    if choice.limit != SumLimit::Motion || choice.still || !readable || !aligns || !known {
        return Ok((capture, None));
    }
    let (sum, frames) = (choice.frames, capture.native_frames());
    let distance = every.map_or(u64::from(sum), |every| every.min(frames)) as u32;
    let bytes = capture.size().pixels() * size_of::<u16>();
    let steps = (f64::from(sum) * choice.motion / FINE).ceil();
    let steps = steps.max(STEPS).clamp(1.0, f64::from(sum));
    let fine = (f64::from(sum) / steps).round().max(1.0) as u32;
    let mut capture = capture.summed_by(fine, options, Some(sensor))?;
    let alignment = |lengths| Alignment::new(lengths, choice.motion, distance);
    let fits = |lengths: Lengths| {
        let Alignment { fine, count, .. } = alignment(lengths);
        let held = (WINDOW * count) as u64;
        held * u64::from(fine) <= frames && held * bytes as u64 <= WINDOW_BYTES
    };
    let lengths = choose(&mut capture, choice, steps as usize, sensor, &fits)?;
    let alignment = lengths.map(alignment);
    let sum = alignment.map_or(sum, |alignment| alignment.fine);
    Ok((capture.summed_by(sum, options, Some(sensor))?, alignment))
}

/// Chooses block and sum for a capture, read in fine sums of which `step` make a plain sum, among those that fit.
fn choose(
    capture: &mut Capture,
    choice: &SumChoice,
    step: usize,
    sensor: &Sensor,
    fits: &dyn Fn(Lengths) -> bool,
) -> Result<Option<Lengths>> {
    let frames = capture.frames() as usize;
    let fine = f64::from(capture.summed());
    let (light, motion) = (choice.detections * fine, choice.motion * fine);
    let block = ((FOUND / light).ceil() as usize).max(step);
    let block = block.min((FASTEST / motion) as usize).min(frames / WINDOW);
    let lengths = |count: usize| Lengths { sum: count as f64 * fine, block: block as f64 * fine };
    let wanted = |&count: &usize| {
        count * WINDOW <= frames
            && count <= block * WINDOW
            && count as f64 * light <= ENOUGH
            && count as f64 * fine <= f64::from(LONGEST)
            && (count == step || fits(lengths(count)))
    };
    let multiples = MULTIPLES.into_iter().chain([frames / WINDOW / step]);
    let mut counts: Vec<usize> = multiples.map(|times| times * step).filter(wanted).collect();
    counts.sort_unstable();
    counts.dedup();
    let (Some(&most), true) = (counts.last(), block > 0 && counts.len() > 1) else {
        return Ok(None);
    };
    let of_frames = capture.output_sensor(sensor)?;
    let ppp = light / of_frames.quantum_efficiency;
    let acquisition = Acquisition::new(of_frames, ppp, qudi_core::USUAL_MEAN_LEVEL)?;
    let length = (WINDOW * block).max(WINDOW * most + 1).min(frames);
    let samples = samples(capture, length)?;
    let size = part(capture.size());
    let views: Vec<_> = samples.iter().map(|frames| BurstView { size, frames }).collect();
    let count = choose_count(&views, &acquisition, block, (step / 4).max(1), &counts)?;
    Ok(count.filter(|&count| count > step).map(lengths))
}

/// The size of what is looked at.
fn part(size: Size) -> Size {
    Size { height: size.height.min(SIDE), width: size.width.min(SIDE) }
}

/// The middle of the picture in stretches of `length` frames all over the capture.
fn samples(capture: &mut Capture, length: usize) -> Result<Vec<Vec<Vec<u16>>>> {
    let (size, part) = (capture.size(), part(capture.size()));
    let (top, left) = ((size.height - part.height) / 2, (size.width - part.width) / 2);
    let room = capture.frames() - length as u64;
    let places = PLACES.min(room / length as u64 + 1);
    let mut counts = vec![0; size.pixels()];
    let mut samples = Vec::new();
    for place in 0..places {
        let first = room * place / (places - 1).max(1);
        let mut stretch = Vec::with_capacity(length);
        for frame in first..first + length as u64 {
            capture.read(frame, &mut counts)?;
            let rows = counts.chunks_exact(size.width).skip(top).take(part.height);
            stretch.push(rows.flat_map(|row| &row[left..left + part.width]).copied().collect());
        }
        samples.push(stretch);
    }
    Ok(samples)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_share_sums_where_they_can() {
        let lengths = Lengths { sum: 576.0, block: 140.0 };
        let alignment = Alignment::new(lengths, 0.021, 100);
        let Alignment { fine, step, block, count } = alignment;
        assert_eq!((fine, step, block, count), (20, 5, 7, 30));
        assert_eq!(alignment.native_frames(), 600);
        assert_eq!(alignment.instants(), Instants::Frames { every: 100, sum: 20 });
        // Pictures farther apart than sums are long need no common length; primes have no divisors.
        assert_eq!(Alignment::new(lengths, 0.021, 1000).count, 29);
        assert_eq!(Alignment::new(lengths, 0.3, 7).fine, 1);
    }
}
