//! Cuts to another scene, and steps of the light.

use super::findings::FrameFindings;
use super::frame_statistics::{BLOCKS, FrameStatistics};

/// Groups of frames in which the scene is followed.
const MAX_GROUPS: usize = 8192;

/// Counts of a block and group that tell one scene from another.
const BLOCK_COUNTS: f64 = 50.0;

/// Factor by which a change exceeds those before and after it, at a cut.
const CUT_FACTOR: f64 = 5.0;

/// Least change of a cut, over what chance explains.
const MIN_CUT: f64 = 8.0;

/// Least relative change of a step of the light.
const MIN_STEP: f64 = 0.25;

/// Finds cuts and steps of the light: changes from one group of frames to the next that are far larger than
/// those before and after. Longer groups show changes of dimmer or fainter scenes.
pub(super) fn changes(frames: &[FrameStatistics], first: u64, findings: &mut FrameFindings) {
    let group = frames.len().div_ceil(MAX_GROUPS);
    let groups: Vec<[f64; BLOCKS]> = frames.chunks(group).map(total).collect();
    let mean = groups.iter().flatten().sum::<f64>() / (groups.len() * BLOCKS) as f64;
    let mut length = ((BLOCK_COUNTS / mean.max(1e-9)).ceil() as usize).max(2);
    let mut found: [Vec<usize>; 2] = Default::default();
    while 4 * length <= groups.len() {
        for (kind, found) in found.iter_mut().enumerate() {
            for at in peaks(&groups, length, kind) {
                if found.iter().all(|other| other.abs_diff(at) > length) {
                    found.push(at);
                }
            }
        }
        length *= 4;
    }
    let [cuts, steps] = found;
    // Another scene has another light, too.
    let steps =
        steps.into_iter().filter(|&step| cuts.iter().all(|cut| cut.abs_diff(step) > length));
    let frame = |at: usize| first + (at * group) as u64;
    findings.light_steps.extend(steps.map(frame));
    findings.cuts.extend(cuts.into_iter().map(frame));
    findings.cuts.sort_unstable();
    findings.light_steps.sort_unstable();
}

/// Returns where windows of `length` groups differ far more from the ones before than their neighbours do: in
/// the picture, or in the light if `kind` is 1.
fn peaks(groups: &[[f64; BLOCKS]], length: usize, kind: usize) -> Vec<usize> {
    let window = |from: usize| {
        let mut sum = [0.0; BLOCKS];
        for blocks in &groups[from..from + length] {
            sum.iter_mut().zip(blocks).for_each(|(sum, block)| *sum += block);
        }
        sum
    };
    let windows: Vec<[f64; BLOCKS]> = (0..=groups.len() - length).map(window).collect();
    let places = length..=groups.len() - length;
    let change = |at: usize| difference(&windows[at - length], &windows[at])[kind];
    let all: Vec<f64> = places.clone().map(change).collect();
    let value = |at: usize| all[at - length];
    let (least, floor) = if kind == 0 { (MIN_CUT, 1.0) } else { (MIN_STEP, 0.02) };
    let is_peak = |&at: &usize| {
        let sides = [at.checked_sub(length), Some(at + length)].into_iter().flatten();
        let usual = sides.filter(|side| places.contains(side)).map(value).fold(floor, f64::max);
        let own = value(at);
        let end = (at + length).min(groups.len() - length);
        let mut near = at.saturating_sub(length).max(length)..=end;
        let is_first = near.all(|other| value(other) < own || value(other) == own && other >= at);
        own > least && own > CUT_FACTOR * usual && is_first
    };
    places.clone().filter(is_peak).collect()
}

fn total(frames: &[FrameStatistics]) -> [f64; BLOCKS] {
    let mut sum = [0.0; BLOCKS];
    for frame in frames {
        sum.iter_mut().zip(frame.blocks).for_each(|(sum, block)| *sum += f64::from(block));
    }
    sum
}

/// Compares two windows: the change of the picture over chance, whatever its light, and of the light.
fn difference(before: &[f64; BLOCKS], after: &[f64; BLOCKS]) -> [f64; 2] {
    let [one, other] = [before, after].map(|blocks| blocks.iter().sum::<f64>());
    if one <= 0.0 || other <= 0.0 {
        return [0.0, 2.0 * f64::from(u8::from(one != other))];
    }
    let scale = one / other;
    let square = |(a, b): (&f64, &f64)| (a - b * scale).powi(2) / (a + b * scale * scale).max(1.0);
    let picture = before.iter().zip(after).map(square).sum::<f64>() / BLOCKS as f64;
    [picture, 2.0 * (one - other).abs() / (one + other)]
}
