//! Frames are judged before they are used: empty, at full scale, repeated, out of family; cuts and steps of
//! the light.

mod counter;
mod exceptions;
mod findings;
mod frame_statistics;
mod gaps;
mod pass;
mod scene_changes;
mod timeline;

pub use findings::FrameFindings;
pub(super) use frame_statistics::FrameStatistics;
pub use timeline::Stretch;

use super::Capture;
use super::piped_frames::PipedFrames;
use crate::description::ReadOptions;
use crate::frames::every_nth::EveryNth;
use crate::frames::shifted::Shifted;
use counter::Counter;
use exceptions::{alternation, first_run, judge};
use gaps::long_gaps;
use qudi_core::Result;
use qudi_core::sensor::{Response, Sensor};
use std::cmp::Reverse;
use std::ops::Range;

/// Share of the frames beyond which they are no exceptions.
const MAX_SHARE: f64 = 0.2;

/// Lowest bits that are empty in all values, if these are shifted.
const SHIFTED_BITS: std::ops::RangeInclusive<u32> = 3..=12;

/// Distinct values that a shift leaves at least.
const MIN_VALUES: u16 = 12;

/// Expected samples of two and more among counts that never exceed one, beyond which they are binary.
const MIN_DOUBLES: f64 = 50.0;

impl Capture {
    /// Judges the frames in one pass over at most `limit` bytes, in stretches of a longer capture, and
    /// applies what is found: a good frame stands in for a broken one, a frame that is stored several times
    /// is read once, values at the upper end of their words are shifted, and parts end at cuts. `options` and
    /// `sensor` are the ones it was opened with. Pipes are judged while they are read.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the capture cannot be read.
    pub fn judge_frames(
        &mut self,
        limit: u64,
        options: &ReadOptions,
        sensor: Option<&Sensor>,
    ) -> Result<()> {
        if self.length().is_none() || self.native_frames() < 2 {
            return Ok(());
        }
        let pixels = self.native.size().pixels();
        let bytes = if self.info.packing.is_some() { pixels.div_ceil(8) } else { 2 * pixels };
        let mut findings = FrameFindings::default();
        let gaps = self.info.gaps.iter().filter(|(frame, _)| self.range.contains(frame));
        self.gaps = gaps.copied().collect();
        let mut seen: Vec<FrameStatistics> = Vec::new();
        let mut times = Vec::new();
        let mut all = stretches(self.native_frames(), limit / bytes as u64);
        if self.forward_only() {
            all.truncate(1);
        }
        for stretch in all {
            let first = self.range.start + stretch.start;
            let (frames, groups, mut edges) =
                self.look_at(first..self.range.start + stretch.end)?;
            let size = self.native.size();
            self.timeline.push(Stretch::new(first, frames.len(), &groups, size));
            judge(&frames, first, &mut findings);
            for change in groups.changes() {
                let at = first + self.place_of(change, first, frames.len())?;
                if change.is_cut { &mut findings.cuts } else { &mut findings.light_steps }.push(at);
            }
            if let Some(counter) = edges.counter() {
                self.take_counter(counter, first);
            }
            times.push(findings.stored_times.take());
            seen.extend(frames);
        }
        self.gaps.sort_unstable_by_key(|&(frame, missing)| (frame, Reverse(missing)));
        self.gaps.dedup_by_key(|(frame, _)| *frame);
        findings.missing = self.gaps.iter().map(|(frame, _)| *frame).collect();
        findings.looked_at = seen.len() as u64;
        findings.alternates = alternation(&seen);
        let bits = seen.iter().fold(0, |bits, frame| bits | frame.bits);
        let largest = seen.iter().map(|frame| frame.largest).fold(0, u16::max);
        let samples = (seen.len() * pixels) as f64;
        let mean = seen.iter().map(|frame| frame.sum as f64).sum::<f64>() / samples;
        let mut replan = self.shift(bits, largest, sensor);
        replan |= self.take_for_binary(largest, mean, samples, sensor);
        let same = times.iter().all(|other| *other == times[0]);
        if let Some(times) = times[0].filter(|_| same) {
            self.read_once(times, first_run(&seen, times), &mut findings);
            replan = true;
        }
        let share = findings.replaced().len() as f64 / seen.len() as f64;
        self.boundaries = self.boundaries_for(&findings, self.sum);
        let replaced = share <= MAX_SHARE;
        if replaced {
            self.replace(&findings.replaced());
            replan |= share > 0.0;
        }
        let longest = self.longest_part();
        super::depth::check_sum(self.sum, longest.end - longest.start, &self.info)?;
        replan |= !self.boundaries.is_empty() && self.sum > 1 || !self.counter.is_empty();
        self.info.notes.extend(findings.notes(replaced));
        self.findings = findings;
        if replan {
            self.held.clear();
            super::pixel_map::plan(self, options, sensor)?;
        }
        Ok(())
    }

    /// Judges frames when they are read, since they come once: the one before stands in for a broken one.
    pub fn judge_while_reading(&mut self) {
        self.piped = Some(PipedFrames::default());
    }

    /// Notes a frame counter, whose pixels are repaired, and the frames that it misses.
    fn take_counter(&mut self, counter: Counter, first: u64) {
        let Counter { pixels, jumps } = counter;
        if self.counter.is_empty() {
            self.info.notes.push(format!(
                "{} pixels from number {} on hold a frame counter: they are repaired",
                pixels.len(),
                pixels[0]
            ));
            self.counter = pixels;
        }
        if let Some((frame, count)) = jumps.first() {
            self.info.notes.push(format!(
                "the frame counter jumps before {} frames, first before frame {}: {count} are missing there",
                jumps.len(),
                first + frame
            ));
        }
        self.gaps.extend(jumps.iter().map(|(frame, count)| (first + frame, *count)));
    }

    /// Returns the first frames of parts that have nothing to do with those before, where `sum` frames are
    /// summed.
    pub(super) fn boundaries_for(&self, findings: &FrameFindings, sum: u32) -> Vec<u64> {
        let changes = findings.cuts.iter().chain(&findings.light_steps).copied();
        let mut frames: Vec<u64> = changes.chain(long_gaps(&self.gaps, &self.range, sum)).collect();
        frames.sort_unstable();
        frames.dedup();
        frames
    }

    /// Returns what was found out about single frames.
    pub fn findings(&self) -> &FrameFindings {
        &self.findings
    }

    /// Returns the light and the changes of the stretches that were looked at.
    pub fn timeline(&self) -> &[Stretch] {
        &self.timeline
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

    /// Reads every frame once that is stored `times` times, the first one `first` times, and counts what was
    /// found by the frames that are left.
    fn read_once(&mut self, times: u64, first: u64, findings: &mut FrameFindings) {
        let frames = std::mem::replace(&mut self.native, Box::new(NoFrames(self.view.size)));
        let once = EveryNth::new(frames, times, self.range.start + first);
        findings.stored_times = Some(times);
        findings.renumber(|frame| once.holding(frame));
        for (frame, missing) in &mut self.gaps {
            (*frame, *missing) = (once.holding(*frame), missing.div_ceil(times));
        }
        for stretch in &mut self.timeline {
            stretch.first = once.holding(stretch.first);
            stretch.step = stretch.step.div_ceil(times);
        }
        self.range = once.among(self.range.start)..once.among(self.range.end);
        self.end = self.end.map(|end| once.among(end));
        self.native = Box::new(once);
        self.info.fps = self.info.fps.map(|fps| fps / times as f64);
    }

    /// Lets the nearest good frame of the same part stand in for each of `bad`.
    fn replace(&mut self, bad: &[u64]) {
        for &frame in bad {
            let part = |at: u64| self.boundaries.partition_point(|&boundary| boundary <= at);
            let good = |other: &u64| {
                self.range.contains(other)
                    && part(*other) == part(frame)
                    && bad.binary_search(other).is_err()
            };
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

/// Fewest frames of a stretch.
const MIN_STRETCH: u64 = 12;

/// Returns stretches of `frames` frames: all, or the beginning, the middle and the end of more than `limit`.
fn stretches(frames: u64, limit: u64) -> Vec<Range<u64>> {
    let part = (limit / 3).max(MIN_STRETCH);
    let length = if frames <= limit.max(3 * part) { frames } else { part };
    let firsts = [0, (frames - length) / 2, frames - length];
    let firsts = if length == frames { &firsts[..1] } else { &firsts[..] };
    firsts.iter().map(|&first| first..first + length).collect()
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
        capture.judge_frames(1 << 30, &options, Some(&sensor)).unwrap();
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
        assert_eq!((findings.cuts, findings.light_steps), (vec![], vec![]));
        let mut counts = vec![0; SIZE.pixels()];
        capture.read(12, &mut counts).unwrap();
        assert_eq!(counts, good[11]);
        let mut sums = vec![0; SIZE.pixels()];
        capture.total(11..13, &mut sums).unwrap();
        assert!(sums.iter().zip(&good[11]).all(|(&sum, &count)| sum == 2 * u32::from(count)));
        assert!(capture.info().notes.iter().any(|note| note.contains("empty frames: 12;")));
    }

    #[test]
    fn frame_counters_are_repaired_and_tell_missing_frames() {
        let mut counted = frames(40, 1.0, 99);
        counted.drain(20..23);
        let numbers = (1000..1020).chain(1023..1040);
        for (counts, number) in counted.iter_mut().zip(numbers) {
            counts[..2].copy_from_slice(&[number >> 8, number & 255]);
        }
        let (capture, findings) = judged(counted);
        assert_eq!(findings.missing, [20]);
        assert_eq!(capture.bad_pixels().hot, [0, 1]);
        let notes = capture.info().notes.join("; ");
        assert!(notes.contains("frame counter") && notes.contains("3 are missing"), "{notes}");
    }

    #[test]
    fn exposures_that_take_turns_are_named() {
        let mut turns = frames(20, 1.0, 99);
        turns.iter_mut().step_by(2).flatten().for_each(|count| *count *= 4);
        let (capture, findings) = judged(turns);
        assert!((findings.alternates.unwrap() - 4.0).abs() < 0.3, "{:?}", findings.alternates);
        assert!(capture.info().notes.iter().any(|note| note.contains("every other frame")));
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
        let (capture, findings) = judged(frames(60, 0.5, 33));
        assert_eq!((findings.cuts, findings.light_steps), (vec![33], vec![]));
        assert_eq!(capture.parts(), [0..33, 33..60]);
        let mut step = frames(60, 0.5, 99);
        step[25..].iter_mut().flatten().for_each(|count| *count = *count * 3 / 2);
        let (_, findings) = judged(step);
        assert_eq!((findings.cuts, findings.light_steps), (vec![], vec![25]));
        let mut twice: Vec<_> = frames(60, 0.5, 33);
        twice = twice.into_iter().flat_map(|frame| [frame.clone(), frame]).collect();
        assert_eq!(judged(twice).1.cuts, [33]);
    }

    /// Few photons show a cut in long windows only, and its place as exactly as they can.
    #[test]
    fn cuts_of_dim_scenes_are_found_near_their_place() {
        let mut dim = frames(600, 0.0, 307);
        dim.iter_mut().flatten().for_each(|count| *count = u16::from(*count > 6));
        let (_, findings) = judged(dim);
        assert_eq!(findings.cuts.len(), 1);
        assert!(findings.cuts[0].abs_diff(307) <= 1, "{:?}", findings.cuts);
    }

    #[test]
    fn no_sum_reaches_over_a_cut() {
        let good = frames(60, 0.5, 33);
        let (mut capture, _) = judged(good.clone());
        capture.info.max_count = Some(99);
        let sensor = Sensor::load("ideal").unwrap();
        let options = crate::description::ReadOptions::default();
        let mut capture = capture.summed_by(7, &options, Some(&sensor)).unwrap();
        assert_eq!(capture.frames(), 33 / 7 + 27 / 7);
        assert_eq!(capture.length(), Some(capture.frames()));
        let total = |frames: &[Vec<u16>]| -> Vec<u16> {
            (0..SIZE.pixels()).map(|i| frames.iter().map(|frame| frame[i]).sum()).collect()
        };
        let mut counts = vec![0; SIZE.pixels()];
        capture.read(3, &mut counts).unwrap();
        assert_eq!(counts, total(&good[21..28]));
        capture.read(4, &mut counts).unwrap();
        assert_eq!(counts, total(&good[33..40]));
        let mut sums = vec![0; SIZE.pixels()];
        capture.total(3..5, &mut sums).unwrap();
        let both = [&good[21..28], &good[33..40]].concat();
        assert!(sums.iter().zip(total(&both)).all(|(&sum, count)| sum == u32::from(count)));
        assert!(capture.summed_by(34, &options, Some(&sensor)).is_err());
    }

    #[test]
    fn shifted_values_and_bits_without_a_depth_are_recognised() {
        let counts = frames(20, 1.0, 99);
        let bright = counts.iter().map(|frame| frame.iter().map(|&c| (c * 5) << 4).collect());
        let sensor = Sensor::load("ideal").unwrap();
        let mut capture = Capture::in_memory("scene", SIZE, bright.collect(), &sensor).unwrap();
        capture.info.max_count = None;
        let options = crate::description::ReadOptions::default();
        capture.judge_frames(1 << 30, &options, None).unwrap();
        let mut read = vec![0; SIZE.pixels()];
        capture.read(3, &mut read).unwrap();
        assert!(read.iter().zip(&counts[3]).all(|(&read, &count)| read == 5 * count));
        let bits = counts.iter().map(|frame| frame.iter().map(|&c| c.min(1)).collect());
        let mut capture = Capture::in_memory("scene", SIZE, bits.collect(), &sensor).unwrap();
        (capture.info.max_count, capture.info.binary) = (None, false);
        capture.judge_frames(1 << 30, &options, None).unwrap();
        assert!(capture.info().binary && capture.max_count() == Some(1));
    }
}
