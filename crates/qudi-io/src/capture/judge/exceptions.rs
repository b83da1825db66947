//! Frames that are not like their neighbours: empty, at one value, out of family, repeated; exposures that
//! take turns.

use super::findings::FrameFindings;
use super::frame_statistics::FrameStatistics;

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

/// Pairs of frames of which one is lighter, if exposures take turns, and the least ratio of their light.
const MIN_TURNS: usize = 5;
const MIN_ALTERNATION: f64 = 1.2;

/// Most often that a frame is stored.
const MAX_TIMES: u64 = 32;

/// Share of runs that have the same length, if every frame is stored as often.
const REGULAR_SHARE: f64 = 0.9;

/// Judges consecutive frames from `first` on.
pub(super) fn judge(frames: &[FrameStatistics], first: u64, findings: &mut FrameFindings) {
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
        let [one, other] = [median(before), median(after)];
        let agree = one.max(other) <= AGREEMENT * one.min(other).max(1.0);
        let (lit_before, lit_after) = around(&lit, n);
        let usual_lit = median(lit_before.into_iter().chain(lit_after).collect());
        let lit = f64::from(frame.lit);
        let is_partial = lit < usual_lit && is_far(lit, usual_lit, MIN_LIT.recip());
        if frame.sum == 0 {
            findings.empty.push(number(n));
        } else if frame.is_constant && ratio > 1.1 {
            findings.saturated.push(number(n));
        } else if agree && (is_far(frame.sum as f64, usual, MIN_FACTOR) || is_partial) {
            findings.outlying.push(number(n));
        }
    }
    repeats(frames, first, findings);
}

/// Returns how much lighter every other frame is, as with exposures that take turns.
pub(super) fn alternation(frames: &[FrameStatistics]) -> Option<f64> {
    let sums = frames.iter().map(|frame| frame.sum as f64);
    let halves = [0, 1].map(|half| sums.clone().skip(half).step_by(2).collect::<Vec<f64>>());
    if halves[1].len() < MIN_TURNS {
        return None;
    }
    let [one, other] = &halves;
    let [even, odd] = halves.each_ref().map(|half| median(half.clone()));
    let apart = |a: f64, b: f64| a > MIN_ALTERNATION * b && a - b > SIGMAS * (a + b).sqrt();
    let pairs = || one.iter().zip(other);
    let takes_turns = pairs().all(|(&a, &b)| apart(a, b)) || pairs().all(|(&a, &b)| apart(b, a));
    takes_turns.then(|| even.max(odd) / even.min(odd).max(1.0))
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
pub(super) fn first_run(frames: &[FrameStatistics], times: u64) -> u64 {
    runs(frames).first().copied().unwrap_or(times).min(times)
}
