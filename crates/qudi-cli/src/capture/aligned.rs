//! Sums that are aligned along motion: where motion keeps sums short, several of them are added along it.

use super::{Source, SummedCapture};
use crate::error::Result;
use crate::methods::Method;
use crate::report::Report;
use qudi_burst::{AlignedSums, choose_count};
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::windows::{LONGEST_HALF, Windows};
use qudi_io::capture::{Capture, SUFFICIENT_DETECTIONS, SumChoice, SumLimit};
use qudi_io::description::ReadOptions;
use qudi_io::restore::{Instants, Schedule};

/// Pixels that may move within a fine sum.
const MAX_FINE_MOTION: f64 = 0.5;

/// Detections per pixel of a block that suffice to find its motion.
const MIN_BLOCK_DETECTIONS: f64 = 1.5;

/// Pixels that may move from one block to the next.
const MAX_BLOCK_MOTION: f64 = 6.0;

/// Lengths of an aligned sum in picture distances. One is no alignment.
const MULTIPLES: [usize; 8] = [1, 2, 3, 5, 8, 12, 18, 27];

/// Fine sums in a picture distance, where it has that many frames, and in an aligned sum: few enough to leave
/// many frames for the choice, and enough to approximate lengths.
const FINE_SUMS: f64 = 8.0;

/// Side of the part of the picture that is sampled.
const SAMPLE_SIDE: usize = 160;

/// Blocks along which motion counts as even, and sums that methods restore together.
const WINDOW: usize = 2 * LONGEST_HALF + 1;

/// Largest number of native frames of a sum, which holds 16 bits.
const MAX_SUM: u32 = 60_000;

/// Largest number of bytes of the counts of a window.
const WINDOW_BYTES: u64 = 256 << 20;

/// Stretches of the capture that are sampled.
const SAMPLED_PLACES: u64 = 4;

/// A capture that a method restores: its frames are sums, which may be aligned along motion.
pub(crate) struct AlignedCapture {
    pub(crate) capture: Capture,
    /// Alignment of its frames, which are fine sums; `None` for plain sums.
    pub(crate) alignment: Option<Alignment>,
}

/// The alignment of the fine sums of a capture, which are its frames.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Alignment {
    /// Native frames in a fine sum.
    fine: u32,
    /// Fine sums from one picture to the next.
    step: u64,
    /// Fine sums in a block.
    block: usize,
    /// Fine sums in an aligned sum.
    count: usize,
}

/// Native frames in an aligned sum, and in the blocks between which motion is found.
#[derive(Clone, Copy, Debug)]
struct Lengths {
    sum: f64,
    block: f64,
}

impl Alignment {
    /// Creates the alignment with `lengths` for a capture that moves by `motion` pixels a native frame, for a
    /// picture every `distance` native frames. Longer sums are multiples of the distance: pictures whose
    /// distance is a multiple of a sum are restored together.
    fn new(lengths: Lengths, motion: f64, distance: u32) -> Self {
        let slow = |fine: &u32| {
            f64::from(*fine) * motion <= MAX_FINE_MOTION
                && FINE_SUMS * f64::from(*fine) <= lengths.sum
        };
        let divides = |fine: &u32| distance.is_multiple_of(*fine);
        let fine = (1..=distance.min(MAX_SUM)).rev().filter(divides).find(slow).unwrap_or(1);
        let step = (distance / fine) as usize;
        let of = |native: f64| ((native / f64::from(fine)).round() as usize).max(1);
        let mut count = of(lengths.sum);
        if count > step {
            count = (count + step / 2) / step * step;
        }
        Self { fine, step: step as u64, block: of(lengths.block), count }
    }

    /// Returns the pictures that are made.
    fn instants(self) -> Instants {
        let sum = u64::from(self.fine);
        Instants::Frames { every: self.step * sum, sum }
    }

    /// Returns the native frames in an aligned sum.
    pub(crate) fn native_frames(self) -> u64 {
        self.count as u64 * u64::from(self.fine)
    }

    /// Returns the fine sums from one picture to the next.
    pub(crate) fn step(self) -> u64 {
        self.step
    }

    /// Describes the alignment in a sentence.
    fn describe(self) -> String {
        format!(
            "motion is followed: each picture is restored from {WINDOW} sums of {} frames, aligned along it; --sum N adds plain sums instead",
            self.native_frames()
        )
    }
}

impl AlignedCapture {
    /// Aligns the sums of a capture, if motion keeps them short and `method` works with aligned sums. The
    /// frames of the capture are then fine sums. One picture is made for every `every` native frames, or for
    /// every sum.
    pub(crate) fn new(
        summed: SummedCapture,
        source: &Source<'_>,
        sensor: &Sensor,
        method: Option<&Method>,
        every: Option<u64>,
    ) -> Result<Self> {
        let SummedCapture { capture, choice, .. } = summed;
        let readable = capture.length().is_some() && !capture.forward_only();
        let aligns = method.is_none_or(|method| method.aligns);
        let known = sensor.dark_per_frame().is_ok();
        // Sums that are aligned by whole pixels would mix the colours of a filter, and only one of three full
        // planes is seen here.
        let aligns = aligns && !capture.has_colours();
        let short = |choice: &SumChoice| choice.limit == SumLimit::Motion && !choice.still;
        match choice.filter(short) {
            Some(choice) if readable && aligns && known => {
                Self::choose(capture, &choice, every, source.options, sensor)
            }
            _ => Ok(Self { capture, alignment: None }),
        }
    }

    /// Chooses whether and how sums of `capture` are aligned.
    fn choose(
        capture: Capture,
        choice: &SumChoice,
        every: Option<u64>,
        options: &ReadOptions,
        sensor: &Sensor,
    ) -> Result<Self> {
        // Lengths are chosen in the longest part between cuts.
        let part = capture.longest_part();
        let (sum, frames) = (choice.frames, part.end - part.start);
        let distance = every.map_or(u64::from(sum), |every| every.min(frames)) as u32;
        let bytes = capture.size().pixels() * size_of::<u16>();
        let steps = (f64::from(sum) * choice.motion / MAX_FINE_MOTION).ceil();
        let steps = steps.max(FINE_SUMS).clamp(1.0, f64::from(sum));
        let fine = (f64::from(sum) / steps).round().max(1.0) as u32;
        let mut capture = capture.summed_by(fine, options, Some(sensor))?;
        let alignment = |lengths| Alignment::new(lengths, choice.motion, distance);
        let fits = |lengths: Lengths| {
            let Alignment { fine, count, .. } = alignment(lengths);
            let held = (WINDOW * count) as u64;
            held * u64::from(fine) <= frames && held * bytes as u64 <= WINDOW_BYTES
        };
        let lengths = capture
            .in_part(&part, |capture| choose(capture, choice, steps as usize, sensor, &fits))?;
        let alignment = lengths.map(alignment);
        let sum = alignment.map_or(sum, |alignment| alignment.fine);
        Ok(Self { capture: capture.summed_by(sum, options, Some(sensor))?, alignment })
    }

    /// Prints that motion is followed, if it is.
    pub(crate) fn remark_alignment(&self, report: &Report) {
        if let Some(alignment) = self.alignment {
            report.remark(&format!("note: {}", alignment.describe()));
        }
    }

    /// Returns the acquisition of the frames that the method sees, where `acquisition` is the capture's.
    pub(crate) fn seen_acquisition(&self, acquisition: &Acquisition) -> Result<Acquisition> {
        match self.alignment {
            Some(alignment) => Ok(AlignedSums::acquisition(acquisition, alignment.count)?),
            None => Ok(acquisition.clone()),
        }
    }

    /// Wraps `method`, so that it sees aligned sums where sums are aligned.
    pub(crate) fn around(&self, method: Box<dyn Restorer>) -> Box<dyn Restorer> {
        match self.alignment {
            Some(Alignment { count, block, .. }) => {
                Box::new(AlignedSums::new(method, count, block))
            }
            None => method,
        }
    }

    /// Returns the capture's frames in one of the sums that the method sees.
    pub(crate) fn frames_per_sum(&self) -> u64 {
        self.alignment.map_or(1, |alignment| alignment.count as u64)
    }

    /// Returns the windows that `restorer` restores, of which neighbours share `overlap` frames, and the
    /// pictures made: one for every `every` native frames, or for every frame.
    pub(crate) fn schedule(
        &self,
        restorer: &dyn Restorer,
        overlap: u64,
        every: Option<u64>,
    ) -> Result<Schedule> {
        let windows = Windows::of(restorer, self.capture.frames(), overlap)?;
        let instants = match (self.alignment, every) {
            (Some(alignment), _) => alignment.instants(),
            (None, Some(every)) => Instants::every(every, &self.capture)?,
            (None, None) => Schedule::all(windows).instants,
        };
        Ok(Schedule { windows, instants })
    }
}

/// Chooses block and sum for a capture, read in fine sums of which `step` make a plain sum, among the lengths
/// that fit.
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
    let block = ((MIN_BLOCK_DETECTIONS / light).ceil() as usize).max(step);
    let block = block.min((MAX_BLOCK_MOTION / motion) as usize).min(frames / WINDOW);
    let lengths = |count: usize| Lengths { sum: count as f64 * fine, block: block as f64 * fine };
    let suits = |&count: &usize| {
        count * WINDOW <= frames
            && count <= block * WINDOW
            && count as f64 * light <= SUFFICIENT_DETECTIONS
            && count as f64 * fine <= f64::from(MAX_SUM)
            && (count == step || fits(lengths(count)))
    };
    let multiples = MULTIPLES.into_iter().chain([frames / WINDOW / step]);
    let mut counts: Vec<usize> = multiples.map(|times| times * step).filter(suits).collect();
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

/// Returns the size of the sampled part of the picture.
fn part(size: Size) -> Size {
    Size { height: size.height.min(SAMPLE_SIDE), width: size.width.min(SAMPLE_SIDE) }
}

/// Reads the middle of the picture in stretches of `length` frames all over the capture.
fn samples(capture: &mut Capture, length: usize) -> Result<Vec<Vec<Vec<u16>>>> {
    let (size, part) = (capture.size(), part(capture.size()));
    let (top, left) = ((size.height - part.height) / 2, (size.width - part.width) / 2);
    let room = capture.frames() - length as u64;
    let places = SAMPLED_PLACES.min(room / length as u64 + 1);
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
