//! Frames are judged before they are used: empty, at full scale, repeated, out of family; cuts and steps of
//! the light.

use super::Capture;
use super::findings::FrameFindings;
use super::frame_statistics::FrameStatistics;
use super::scene_changes::changes;
use crate::description::ReadOptions;
use crate::frames::every_nth::EveryNth;
use crate::frames::shifted::Shifted;
use qudi_core::Result;
use qudi_core::sensor::{Response, Sensor};

/// Neighbours on each side whose median a frame is compared with.
const NEIGHBOURS: usize = 4;

/// Counts of a usual frame below which an empty one may be chance.
const MIN_SUM: u64 = 30;

/// Factor by which the light of a frame out of family differs.
const MIN_FACTOR: f64 = 2.0;

/// Standard deviations of a count beyond which chance explains nothing.
const SIGMAS: f64 = 8.0;

/// Share of lit pixels, over its neighbours', below which a part of a frame is missing.
const MIN_LIT: f64 = 0.7;

/// Ratio of the light of the neighbours before and after within which they agree.
const AGREEMENT: f64 = 1.3;

/// Share of the frames beyond which they are no exceptions.
const MAX_SHARE: f64 = 0.2;

/// Most often that a frame is stored.
const MAX_TIMES: u64 = 32;

/// Share of runs that have the same length, if every frame is stored as often.
const REGULAR_SHARE: f64 = 0.9;

/// Lowest bits that are empty in all values, if these are shifted.
const SHIFTED_BITS: std::ops::RangeInclusive<u32> = 3..=12;

/// Distinct values that a shift leaves at least.
const MIN_VALUES: u16 = 12;

/// Expected samples of two and more among counts that never exceed one, beyond which they are binary.
const MIN_DOUBLES: f64 = 50.0;

impl Capture {
    /// Judges at most `limit` frames in one pass, in stretches spread over the capture, and applies what is
    /// found: a good frame stands in for a broken one, a frame that is stored several times is read once, and
    /// values at the upper end of their words are shifted. `options` and `sensor` are the ones it was opened
    /// with. Captures that can be read once only are not judged.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the capture cannot be read.
    pub fn judge_frames(
        &mut self,
        limit: u64,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<()> {
        if self.forward_only() || self.length().is_none() || self.native_frames() < 2 {
            return Ok(());
        }
        let size = self.native.size();
        let mut findings = FrameFindings::default();
        let mut seen: Vec<FrameStatistics> = Vec::new();
        let mut largest = 0;
        let mut times = Vec::new();
        for stretch in stretches(self.native_frames(), limit) {
            let first = self.range.start + stretch.start;
            let mut frames = Vec::new();
            for frame in first..self.range.start + stretch.end {
                self.native.read(frame, &mut self.stored)?;
                frames.push(FrameStatistics::of(&self.stored, size));
            }
            findings.looked_at += frames.len() as u64;
            largest = frames.iter().map(|frame| frame.largest.0).fold(largest, u16::max);
            judge(&frames, first, size.pixels(), &mut findings);
            times.push(findings.stored_times.take());
            seen.append(&mut frames);
        }
        let bits = seen.iter().fold(0, |bits, frame| bits | frame.bits);
        let mean = seen.iter().map(|frame| frame.sum as f64).sum::<f64>()
            / (seen.len() * size.pixels()) as f64;
        let samples = (seen.len() * size.pixels()) as f64;
        let mut replan = self.shift(bits, largest, sensor);
        replan |= self.take_for_binary(largest, mean, samples, sensor);
        let same = times.iter().all(|other| *other == times[0]);
        if let Some(times) = times[0].filter(|_| same) {
            self.read_once(times, first_run(&seen, times));
            // Numbers of frames are now others.
            findings = FrameFindings { stored_times: Some(times), ..FrameFindings::default() };
            findings.looked_at = seen.len() as u64;
            replan = true;
        }
        let share = findings.replaced().len() as f64 / seen.len() as f64;
        let replaced = share <= MAX_SHARE;
        if replaced {
            self.replace(&findings.replaced());
            replan |= share > 0.0;
        }
        self.info.notes.extend(findings.notes(replaced));
        self.findings = findings;
        if replan {
            super::pixel_map::plan(self, options, sensor)?;
        }
        Ok(())
    }

    /// Returns what was found out about single frames.
    pub fn findings(&self) -> &FrameFindings {
        &self.findings
    }

    /// Shifts values whose lowest bits are all empty; returns true if they are.
    fn shift(&mut self, bits: u16, largest: u16, sensor: Option<&Sensor>) -> bool {
        let empty = bits.trailing_zeros().min(15);
        let gain = sensor.and_then(Sensor::fixed_gain).unwrap_or(1.0);
        let of_gain = gain > 1.0 && gain % 2.0 == 0.0;
        let is_shifted =
            SHIFTED_BITS.contains(&empty) && largest >> empty >= MIN_VALUES && !of_gain;
        let is_plain = self.info.max_count.is_none() && !self.info.is_recorded();
        if !is_shifted || !is_plain {
            return false;
        }
        let frames = std::mem::replace(&mut self.native, Box::new(NoFrames(self.view.size)));
        self.native = Box::new(Shifted::new(frames, empty));
        self.info.notes.push(format!(
            "all values are multiples of {}, as of {} bits at the upper end of 16: they are shifted back",
            1u32 << empty,
            16 - empty
        ));
        true
    }

    /// Takes counts that never exceed one for binary frames, where chance would have made some of them two.
    fn take_for_binary(
        &mut self,
        largest: u16,
        mean: f64,
        samples: f64,
        sensor: Option<&Sensor>,
    ) -> bool {
        let linear = sensor.is_some_and(|sensor| sensor.response == Response::Linear);
        let doubles = samples * mean * mean / 2.0;
        if self.info.max_count.is_some() || largest != 1 || linear || doubles < MIN_DOUBLES {
            return false;
        }
        self.info.max_count = Some(1);
        self.info.binary = true;
        self.info.notes.push("all values are 0 or 1: read as binary frames".to_owned());
        true
    }

    /// Reads every frame once that is stored `times` times, the first one `first` times.
    fn read_once(&mut self, times: u64, first: u64) {
        let frames = std::mem::replace(&mut self.native, Box::new(NoFrames(self.view.size)));
        let once = EveryNth::new(frames, times, self.range.start + first);
        self.range = once.among(self.range.start)..once.among(self.range.end);
        self.end = self.end.map(|end| once.among(end));
        self.native = Box::new(once);
        self.info.fps = self.info.fps.map(|fps| fps / times as f64);
    }

    /// Lets the nearest good frame stand in for each of `bad`.
    fn replace(&mut self, bad: &[u64]) {
        for &frame in bad {
            let good = |frame: &u64| self.range.contains(frame) && !bad.contains(frame);
            let nearest = (1..self.native_frames())
                .flat_map(|far| [frame.wrapping_sub(far), frame + far])
                .find(good);
            self.stand_ins.extend(nearest.map(|nearest| (frame, nearest)));
        }
    }
}

/// Stands for frames while they are wrapped.
struct NoFrames(qudi_core::Size);

impl crate::frames::CountFrames for NoFrames {
    fn frames(&self) -> u64 {
        0
    }

    fn size(&self) -> qudi_core::Size {
        self.0
    }

    fn read(&mut self, _: u64, _: &mut [u16]) -> Result<()> {
        Ok(())
    }
}

/// Returns stretches of `frames` frames with at most `limit` in all: the beginning, the middle, the end.
fn stretches(frames: u64, limit: u64) -> Vec<std::ops::Range<u64>> {
    let length = if frames <= limit { frames } else { (limit / 3).max(2) };
    let firsts = [0, (frames - length) / 2, frames - length];
    let firsts = if length == frames { &firsts[..1] } else { &firsts[..] };
    firsts.iter().map(|&first| first..first + length).collect()
}

/// Judges consecutive frames from `first` on.
fn judge(frames: &[FrameStatistics], first: u64, pixels: usize, findings: &mut FrameFindings) {
    let sums: Vec<f64> = frames.iter().map(|frame| frame.sum as f64).collect();
    let lit: Vec<f64> = frames.iter().map(|frame| f64::from(frame.lit)).collect();
    let number = |n: usize| first + n as u64;
    for (n, frame) in frames.iter().enumerate() {
        let (before, after) = around(&sums, n);
        let usual = median(before.iter().chain(&after).copied().collect());
        if usual < MIN_SUM as f64 {
            continue;
        }
        let ratio = frame.sum as f64 / usual;
        let (most, at_most) = frame.largest;
        let is_constant = most > 0 && f64::from(at_most) > 0.95 * pixels as f64;
        let [one, other] = [median(before), median(after)];
        let agree = one.max(other) <= AGREEMENT * one.min(other).max(1.0);
        let (lit_before, lit_after) = around(&lit, n);
        let usual_lit = median(lit_before.into_iter().chain(lit_after).collect());
        let lit = f64::from(frame.lit);
        let is_partial = lit < usual_lit && is_far(lit, usual_lit, MIN_LIT.recip());
        if frame.sum == 0 {
            findings.empty.push(number(n));
        } else if is_constant && ratio > 1.1 {
            findings.saturated.push(number(n));
        } else if agree && (is_far(frame.sum as f64, usual, MIN_FACTOR) || is_partial) {
            findings.outlying.push(number(n));
        }
    }
    repeats(frames, first, findings);
    changes(frames, first, findings);
}

/// Returns true if a number of counts is off by a factor, and by far more than chance explains.
fn is_far(value: f64, usual: f64, factor: f64) -> bool {
    let ratio = value / usual;
    !(factor.recip()..=factor).contains(&ratio) && (value - usual).abs() > SIGMAS * usual.sqrt()
}

/// Returns the values around number `n`, before and after.
fn around(values: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    let before = values[n.saturating_sub(NEIGHBOURS)..n].to_vec();
    let after = values[n + 1..(n + 1 + NEIGHBOURS).min(values.len())].to_vec();
    match (before.is_empty(), after.is_empty()) {
        (true, _) => (after.clone(), after),
        (_, true) => (before.clone(), before),
        _ => (before, after),
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Returns the lengths of runs of equal frames that show something.
fn runs(frames: &[FrameStatistics]) -> Vec<u64> {
    let mut runs = Vec::new();
    for (n, frame) in frames.iter().enumerate() {
        let repeats = n > 0 && frame.hash == frames[n - 1].hash && frame.sum > 0;
        match runs.last_mut() {
            Some(run) if repeats => *run += 1,
            _ => runs.push(1),
        }
    }
    runs
}

/// Finds frames that repeat the one before, and whether all do as often.
fn repeats(frames: &[FrameStatistics], first: u64, findings: &mut FrameFindings) {
    let runs = runs(frames);
    if runs.len() >= 3 {
        // The ends may be cut off.
        let inner = &runs[1..runs.len() - 1];
        let times = inner[inner.len() / 2];
        let same = inner.iter().filter(|&&run| run == times).count() as f64;
        let regular = same >= REGULAR_SHARE * inner.len() as f64 && runs.len() >= 4;
        if (2..=MAX_TIMES).contains(&times) && regular {
            findings.stored_times = Some(times);
            return;
        }
    }
    let mut at = first;
    for run in runs {
        findings.repeated.extend(at + 1..at + run);
        at += run;
    }
}

/// Returns the length of the first run, at most `times`.
fn first_run(frames: &[FrameStatistics], times: u64) -> u64 {
    runs(frames).first().copied().unwrap_or(times).min(times)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;
    use qudi_core::random::{Domain, Streams, uniform};

    const SIZE: Size = Size { height: 48, width: 64 };

    /// Draws counts of a moving texture, or of another one from frame `cut` on.
    fn frames(count: u64, speed: f64, cut: u64) -> Vec<Vec<u16>> {
        let mut rng = Streams::new(3).row(Domain::Photons, 0, 0);
        let value = |x: f64, y: f64, other: bool| {
            let (x, y) = if other { (y, -x) } else { (x, y) };
            6.0 * (0.5 + 0.3 * (x / 5.0).sin() * (y / 7.0).cos() + 0.15 * (y / 3.0).sin())
        };
        let mut draw = |mean: f64| {
            let (mut count, mut product) = (0, uniform(&mut rng));
            while product > (-mean).exp() {
                product *= uniform(&mut rng);
                count += 1;
            }
            count
        };
        let frame = |t: u64| {
            (0..SIZE.pixels())
                .map(|i| {
                    let (x, y) = ((i % SIZE.width) as f64, (i / SIZE.width) as f64);
                    draw(value(x - speed * t as f64, y, t >= cut))
                })
                .collect()
        };
        (0..count).map(frame).collect()
    }

    fn judged(frames: Vec<Vec<u16>>) -> (Capture, FrameFindings) {
        let sensor = Sensor::load("ideal").unwrap();
        let mut capture = Capture::in_memory("scene", SIZE, frames, &sensor).unwrap();
        let options = crate::description::ReadOptions::default();
        capture.judge_frames(1000, &options, Some(&sensor)).unwrap();
        let findings = capture.findings().clone();
        (capture, findings)
    }

    #[test]
    fn nothing_is_found_where_nothing_is() {
        for speed in [0.0, 1.0, 6.0] {
            let (capture, findings) = judged(frames(40, speed, 99));
            assert_eq!(findings, FrameFindings { looked_at: 40, ..FrameFindings::default() });
            assert!(capture.info().notes.is_empty());
        }
    }

    #[test]
    fn broken_frames_are_named_and_neighbours_stand_in() {
        let good = frames(30, 1.0, 99);
        let mut broken = good.clone();
        broken[12].fill(0);
        broken[20].fill(u16::MAX);
        broken[25].iter_mut().for_each(|count| *count *= 9);
        broken[7][..SIZE.pixels() / 2].fill(0);
        let (mut capture, findings) = judged(broken);
        assert_eq!(
            (findings.empty, findings.saturated, findings.outlying),
            (vec![12], vec![20], vec![7, 25])
        );
        let mut counts = vec![0; SIZE.pixels()];
        capture.read(12, &mut counts).unwrap();
        assert_eq!(counts, good[11]);
        let mut sums = vec![0; SIZE.pixels()];
        capture.total(11..13, &mut sums).unwrap();
        assert!(sums.iter().zip(&good[11]).all(|(&sum, &count)| sum == 2 * u32::from(count)));
        assert!(capture.info().notes.iter().any(|note| note.contains("empty frames: 12;")));
    }

    #[test]
    fn repeated_frames_are_read_once() {
        let once = frames(20, 1.0, 99);
        let twice: Vec<_> = once.iter().flat_map(|frame| [frame.clone(), frame.clone()]).collect();
        let (mut capture, findings) = judged(twice[1..].to_vec());
        assert_eq!((findings.stored_times, capture.frames()), (Some(2), 20));
        let mut counts = vec![0; SIZE.pixels()];
        for (number, frame) in (0..).zip(&once) {
            capture.read(number, &mut counts).unwrap();
            assert_eq!(&counts, frame);
        }
        let mut one = once.clone();
        one.insert(9, once[8].clone());
        assert_eq!(judged(one).1.repeated, [9]);
    }

    #[test]
    fn cuts_and_steps_of_the_light_are_named() {
        let (_, findings) = judged(frames(60, 0.5, 33));
        assert_eq!((findings.cuts, findings.light_steps), (vec![33], vec![]));
        let mut step = frames(60, 0.5, 99);
        step[25..].iter_mut().flatten().for_each(|count| *count = *count * 3 / 2);
        let (_, findings) = judged(step);
        assert_eq!((findings.cuts, findings.light_steps), (vec![], vec![25]));
    }

    #[test]
    fn shifted_values_and_bits_without_a_depth_are_recognised() {
        let counts = frames(20, 1.0, 99);
        let bright = counts.iter().map(|frame| frame.iter().map(|&c| (c * 5) << 4).collect());
        let sensor = Sensor::load("ideal").unwrap();
        let mut capture = Capture::in_memory("scene", SIZE, bright.collect(), &sensor).unwrap();
        capture.info.max_count = None;
        let options = crate::description::ReadOptions::default();
        capture.judge_frames(1000, &options, None).unwrap();
        let mut read = vec![0; SIZE.pixels()];
        capture.read(3, &mut read).unwrap();
        assert!(read.iter().zip(&counts[3]).all(|(&read, &count)| read == 5 * count));
        let bits = counts.iter().map(|frame| frame.iter().map(|&c| c.min(1)).collect());
        let mut capture = Capture::in_memory("scene", SIZE, bits.collect(), &sensor).unwrap();
        (capture.info.max_count, capture.info.binary) = (None, false);
        capture.judge_frames(1000, &options, None).unwrap();
        assert!(capture.info().binary && capture.max_count() == Some(1));
    }
}
