//! Sums that are aligned by themselves: where motion keeps sums short, several of them are added along it.

use crate::error::Result;
use qudi_burst::{AlignedSums, choose_count};
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_io::capture::{Capture, ReadOptions, SumChoice, SumLimit};
use qudi_io::restore::Instants;

/// Methods that sums are aligned for: those that align frames themselves.
const METHODS: [&str; 4] = ["qbp", "qbp-bm3d", "qbp-refined", "qudi"];

/// Pixels that may move within the sums that are shifted.
const FINE: f64 = 0.5;

/// Detections per pixel of a block, enough for its motion to be found.
const FOUND: f64 = 1.5;

/// Pixels that may move from one block to the next.
const FASTEST: f64 = 6.0;

/// Picture distances of which an aligned sum may consist. One is no alignment.
const MULTIPLES: [usize; 8] = [1, 2, 3, 5, 8, 12, 18, 27];

/// Fine sums in a picture distance, where it has that many frames: few enough are held back to choose by.
const STEPS: f64 = 8.0;

/// Side of the part of the picture that is looked at.
const SIDE: usize = 160;

/// Blocks along which motion is taken for even, and sums that methods restore together.
const WINDOW: usize = 11;

/// Detections per pixel of a sum beyond which more light is not needed.
const ENOUGH: f64 = 20.0;

/// Bytes of the counts of a window, at most.
const WINDOW_BYTES: usize = 256 << 20;

/// Stretches of the capture that are looked at.
const PLACES: u64 = 4;

/// How the fine sums of a capture, read as its frames, are aligned.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Alignment {
    /// Fine sums in an aligned one.
    pub(crate) count: usize,
    /// Fine sums in a block.
    block: usize,
    /// Fine sums from one picture to the next.
    step: u64,
    /// Native frames in a fine sum.
    fine: u32,
}

impl Alignment {
    /// The pictures that are made, one for each sum that motion allows.
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

/// Finds out whether sums of `capture`, which motion keeps short, can be aligned for `method`. If so, its frames
/// become the fine sums that are shifted.
pub(crate) fn align_by_itself(
    capture: Capture,
    choice: &SumChoice,
    method: Option<&str>,
    options: &ReadOptions,
    sensor: &Sensor,
) -> Result<(Capture, Option<Alignment>)> {
    let readable = capture.length().is_some() && !capture.forward_only();
    let aligns = method.is_none_or(|method| METHODS.contains(&method));
    let known = sensor.dark_per_frame().is_ok();
    if choice.limit != SumLimit::Motion || choice.still || !readable || !aligns || !known {
        return Ok((capture, None));
    }
    let sum = choice.frames;
    let steps = (f64::from(sum) * choice.motion / FINE).ceil();
    let steps = steps.max(STEPS).clamp(1.0, f64::from(sum));
    let fine = (f64::from(sum) / steps).round().max(1.0) as u32;
    let mut capture = capture.summed_by(fine, options, Some(sensor))?;
    let step = steps as usize;
    let candidate = Alignment { count: step, block: 0, step: step as u64, fine };
    match choose(&mut capture, choice, candidate, sensor)? {
        Some(alignment) => Ok((capture, Some(alignment))),
        None => Ok((capture.summed_by(sum, options, Some(sensor))?, None)),
    }
}

/// Chooses block and count for the fine sums of `capture`.
fn choose(
    capture: &mut Capture,
    choice: &SumChoice,
    candidate: Alignment,
    sensor: &Sensor,
) -> Result<Option<Alignment>> {
    let (frames, pixels) = (capture.frames() as usize, capture.size().pixels());
    let light = choice.detections * f64::from(candidate.fine);
    let motion = choice.motion * f64::from(candidate.fine);
    let block = ((FOUND / light).ceil() as usize).max(candidate.count);
    let block = block.min((FASTEST / motion) as usize).min(frames / WINDOW);
    let fits = |&count: &usize| {
        count * WINDOW <= frames
            && count <= block * WINDOW
            && count as f64 * light <= ENOUGH
            && count * WINDOW * pixels * size_of::<u16>() <= WINDOW_BYTES
    };
    let multiples = MULTIPLES.into_iter().chain([frames / WINDOW / candidate.count]);
    let mut counts: Vec<usize> =
        multiples.map(|times| times * candidate.count).filter(fits).collect();
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
    let held = (candidate.count / 4).max(1);
    let count = choose_count(&views, &acquisition, block, held, &counts)?;
    Ok(count.filter(|&count| count > candidate.count).map(|count| Alignment {
        count,
        block,
        ..candidate
    }))
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
