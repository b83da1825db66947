//! Cuts to another scene, and steps of the light.

use super::frame_statistics::{BLOCKS, Blocks};

/// Groups of frames in which the scene is followed.
const MAX_GROUPS: usize = 2048;

/// Counts of a block and group that tell one scene from another.
const BLOCK_COUNTS: f64 = 50.0;

/// Factor by which a change exceeds those before and after it, at a cut.
const CUT_FACTOR: f64 = 5.0;

/// Least change of a cut, over what chance explains.
const MIN_CUT: f64 = 8.0;

/// Least relative change of a step of the light.
const MIN_STEP: f64 = 0.25;

/// Counts of a block that are assumed besides those that were seen.
const PRIOR: f64 = 0.5;

/// Counts of the blocks of a picture.
pub(super) type Counts = [f64; BLOCKS];

/// Counts of consecutive frames, added up in groups of equal length.
pub(super) struct Groups {
    /// Frames in a group.
    pub(super) length: usize,
    frames: usize,
    pub(super) counts: Vec<Counts>,
}

/// A change of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Change {
    /// About the first frame after it.
    pub(super) at: usize,
    /// Frames before and after that show it.
    pub(super) reach: usize,
    /// True if it is one of the picture, not of the light alone.
    pub(super) is_cut: bool,
}

impl Groups {
    /// Creates the groups of `frames` frames.
    pub(super) fn new(frames: usize) -> Self {
        Self { length: frames.div_ceil(MAX_GROUPS).max(1), frames: 0, counts: Vec::new() }
    }

    /// Adds the next frame.
    pub(super) fn push(&mut self, blocks: &Blocks) {
        if self.frames.is_multiple_of(self.length) {
            self.counts.push([0.0; BLOCKS]);
        }
        self.frames += 1;
        if let Some(counts) = self.counts.last_mut() {
            counts.iter_mut().zip(blocks.0).for_each(|(sum, count)| *sum += f64::from(count));
        }
    }

    /// Finds cuts and steps of the light: changes from one group of frames to the next that are far larger
    /// than those before and after. Longer windows show changes of dimmer or fainter scenes.
    pub(super) fn changes(&self) -> Vec<Change> {
        // Counts before each group, and before the end.
        let mut before = vec![[0.0; BLOCKS]];
        for counts in &self.counts {
            let last = before[before.len() - 1];
            before.push(std::array::from_fn(|i| last[i] + counts[i]));
        }
        let groups = self.counts.len();
        let mean = before[groups].iter().sum::<f64>() / (groups * BLOCKS) as f64;
        let mut window = ((BLOCK_COUNTS / mean.max(1e-9)).ceil() as usize).max(2);
        let mut found: [Vec<Change>; 2] = Default::default();
        while 4 * window <= groups {
            let all = differences(&before, window);
            for (kind, found) in found.iter_mut().enumerate() {
                for at in peaks(&all, window, kind) {
                    let (at, reach) = (at * self.length, window * self.length);
                    if found.iter().all(|other| other.at.abs_diff(at) > reach) {
                        found.push(Change { at, reach, is_cut: kind == 0 });
                    }
                }
            }
            window *= 4;
        }
        let [mut found, steps] = found;
        // Another scene has another light, too.
        let is_step = |step: &Change| {
            let reach = |cut: &Change| cut.reach.max(step.reach);
            found.iter().all(|cut| cut.at.abs_diff(step.at) > reach(cut))
        };
        let mut steps: Vec<Change> = steps.into_iter().filter(is_step).collect();
        found.append(&mut steps);
        found.sort_unstable_by_key(|change| change.at);
        found
    }
}

/// Compares neighbouring windows of `length` groups at every place; `before` has the counts before each
/// group.
fn differences(before: &[Counts], length: usize) -> Vec<[f64; 2]> {
    let window = |first: usize| -> Counts {
        std::array::from_fn(|i| before[first + length][i] - before[first][i])
    };
    let places = length..before.len() - length;
    places.map(|at| difference(&window(at - length), &window(at))).collect()
}

/// Returns where windows of `length` groups differ far more from the ones before than their neighbours do: in
/// the picture, or in the light if `kind` is 1. `all` has the differences at every place.
fn peaks(all: &[[f64; 2]], length: usize, kind: usize) -> Vec<usize> {
    let groups = all.len() - 1 + 2 * length;
    let places = length..=groups - length;
    let value = |at: usize| all[at - length][kind];
    let (least, floor) = if kind == 0 { (MIN_CUT, 1.0) } else { (MIN_STEP, 0.02) };
    let is_peak = |&at: &usize| {
        let sides = [at.checked_sub(length), Some(at + length)].into_iter().flatten();
        let usual = sides.filter(|side| places.contains(side)).map(value).fold(floor, f64::max);
        let own = value(at);
        let end = (at + length).min(groups - length);
        let mut near = at.saturating_sub(length).max(length)..=end;
        own > least
            && own > CUT_FACTOR * usual
            && near.all(|other| value(other) < own || value(other) == own && other >= at)
    };
    places.clone().filter(is_peak).collect()
}

/// Adds up pictures.
pub(super) fn total(pictures: &[Counts]) -> Counts {
    let mut sum = [0.0; BLOCKS];
    for counts in pictures {
        sum.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
    }
    sum
}

/// Compares two windows: the change of the picture over chance, whatever its light, and of the light.
pub(super) fn difference(before: &Counts, after: &Counts) -> [f64; 2] {
    let [one, other] = [before, after].map(|blocks| blocks.iter().sum::<f64>());
    if one <= 0.0 || other <= 0.0 {
        return [0.0, 2.0 * f64::from(u8::from(one != other))];
    }
    let scale = one / other;
    let square = |(a, b): (&f64, &f64)| (a - b * scale).powi(2) / (a + b * scale * scale).max(1.0);
    let picture = before.iter().zip(after).map(square).sum::<f64>() / BLOCKS as f64;
    [picture, 2.0 * (one - other).abs() / (one + other)]
}

/// Returns the place among `frames`, whose first and last quarter lie on either side of a change, where the
/// frames before and after are most likely: counts are Poisson distributed.
pub(super) fn most_likely_place(frames: &[Counts]) -> usize {
    let quarter = (frames.len() / 4).max(1);
    let rates =
        |frames: &[Counts]| total(frames).map(|count| (count + PRIOR) / frames.len() as f64);
    let (before, after) = (rates(&frames[..quarter]), rates(&frames[frames.len() - quarter..]));
    let excess = before.iter().sum::<f64>() - after.iter().sum::<f64>();
    let ratios: Vec<f64> = before.iter().zip(&after).map(|(a, b)| (a / b).ln()).collect();
    let mut likelihood = 0.0;
    let (mut best, mut place) = (f64::NEG_INFINITY, quarter);
    for (n, frame) in frames.iter().enumerate().take(frames.len() + 1 - quarter) {
        if n >= quarter && likelihood > best {
            (best, place) = (likelihood, n);
        }
        likelihood += frame.iter().zip(&ratios).map(|(count, ratio)| count * ratio).sum::<f64>();
        likelihood -= excess;
    }
    place
}
