//! Selection of motion hypotheses. Every patch moves as it was matched frame by frame, with constant
//! velocity, or with most of the image, whichever the counts of all frames make most likely.
//!
//! Matching reference frames repeats their errors: lost detail cannot be matched, and artefacts move as they
//! were merged. Counts are independent from frame to frame. A hypothesis is therefore judged by the
//! likelihood of the counts of all frames. The model of a patch is the reference estimate, plus an unknown
//! difference that is the same in all frames, plus noise.

use super::constant_velocity::ConstantVelocity;
use super::global_motion::GlobalMotion;
use super::patch_refinement::refine;
use super::pyramid::smooth;
use super::reference_frames::ReferenceFrames;
use crate::patch::{Patch, PatchMotion, SIDE, bilinear, inside, total};
use crate::prepared_burst::PreparedBurst;
use multiversion::multiversion;
use qudi_core::Frame;
use rayon::prelude::*;
use std::ops::Range;

/// Largest increase of a frame's misfit on a selected hypothesis, in units of the noise's variance. Beyond it
/// the patch is occluded, and the frame's own match is kept.
const MAX_EXTRA_MISFIT: f32 = 100.0;

/// Settings of the selection, which depend on the source of the reference's patch.
#[derive(Clone, Copy)]
struct Settings {
    /// Variance of one frame's noise over the variance of the reference's errors, both after smoothing. It is
    /// 0 where the reference tells nothing beyond its own counts.
    known: f32,
    /// Penalty of each pixel that leaves the image, in units of the noise's variance.
    outside: f32,
    /// Side of the judged windows, in patches.
    window: usize,
}

impl Settings {
    /// Settings for a reference that is a frame of counts.
    const COUNTS: Self = Self { known: 0.0, outside: 10.0, window: 2 };
    /// Settings for a reference that is an estimate.
    const ESTIMATE: Self = Self { known: 6.0, outside: 0.1, window: 1 };
}

/// Penalties of hypotheses on reference frames, in units of the noise's variance. Reference frames contain
/// the noise of the same counts that judge hypotheses found on them. The less constrained a hypothesis is,
/// the more of that noise it fits, and the merge then averages noise with itself.
mod penalty {
    pub(crate) const MATCHED_PATCHES: f32 = 200.0;
    pub(crate) const CONSTANT: f32 = 200.0;
    pub(crate) const CONSTANT_REFINED: f32 = 150.0;
    pub(crate) const GLOBAL_REFINED: f32 = 100.0;
    pub(crate) const GLOBAL: f32 = 0.0;
    pub(crate) const REST: f32 = 0.0;
}

/// Fraction of the variance of white noise that remains after smoothing along an axis.
const REMAINING_VARIANCE: f32 = 70.0 / 256.0;
/// Correlation of neighbouring pixels after smoothing.
const CORRELATION: f32 = 0.8;

/// Penalty of a hypothesis, and the motion that it gives every patch.
pub(crate) type Hypothesis = (f32, PatchMotion);

/// Selects the motion of every patch of frame `reference` by the counts of `judged` frames alone. The
/// candidates are the `matched` motion, which has a penalty, constant velocity and global motion. Without
/// velocities, the matched motion is returned.
pub(crate) fn select_on_counts(
    burst: &PreparedBurst,
    velocity: Option<&ConstantVelocity>,
    global: Option<&GlobalMotion>,
    reference: usize,
    judged: &Range<usize>,
    (penalty, matched): Hypothesis,
) -> PatchMotion {
    let Some(velocity) = velocity else { return matched };
    let global = global.map(|global| global_hypothesis(burst, global, reference));
    let others = [velocity.motion(reference)].into_iter().chain(global);
    let others = others.map(|motion| (0.0, motion));
    let hypotheses: Vec<Hypothesis> = [(penalty, matched)].into_iter().chain(others).collect();
    let template = &velocity.smoothed[reference];
    let selector = HypothesisSelector {
        burst,
        frames: &velocity.smoothed,
        judged: judged.clone(),
        template,
        settings: Settings::COUNTS,
    };
    selector.select_all(reference, &hypotheses)
}

/// Selects the motion of every patch of frame `reference`. The candidates are the `matched` motion, rest, and
/// constant velocity and global motion, each unchanged and refined on the reference frames. Without
/// velocities, the matched motion is returned.
pub(crate) fn select_on_estimates(
    burst: &PreparedBurst,
    velocity: Option<&ConstantVelocity>,
    references: &ReferenceFrames,
    reference: usize,
    matched: PatchMotion,
) -> PatchMotion {
    let Some(velocity) = velocity else { return matched };
    let constant = velocity.motion(reference);
    let refined = refine_all(burst, references, &constant, reference);
    let rest = vec![vec![[0.0; 2]; burst.grid.len()]; burst.frames.len()];
    let mut hypotheses = vec![
        (penalty::MATCHED_PATCHES, matched),
        (penalty::CONSTANT, constant),
        (penalty::CONSTANT_REFINED, refined),
        (penalty::REST, rest),
    ];
    if let Some(global) = &references.global_motion {
        let motion = global_hypothesis(burst, global, reference);
        let refined = refine_all(burst, references, &motion, reference);
        hypotheses.push((penalty::GLOBAL_REFINED, refined));
        hypotheses.push((penalty::GLOBAL, motion));
    }
    let template = &smooth(&references.frames[reference]);
    let selector = HypothesisSelector {
        burst,
        frames: &velocity.smoothed,
        judged: 0..burst.frames.len(),
        template,
        settings: Settings::ESTIMATE,
    };
    selector.select_all(reference, &hypotheses)
}

/// Evaluates the global motion at the centres of all patches.
fn global_hypothesis(
    burst: &PreparedBurst,
    global: &GlobalMotion,
    reference: usize,
) -> PatchMotion {
    let half = 0.5 * (SIDE - 1) as f32;
    let centres: Vec<[f32; 2]> = (0..burst.grid.len())
        .map(|i| burst.grid.corner(i).map(|corner| corner as f32 + half))
        .collect();
    let motion = |k| centres.iter().map(|&at| global.displacement(at, reference, k)).collect();
    (0..burst.frames.len()).map(motion).collect()
}

/// Refines displacements on the reference frames.
fn refine_all(
    burst: &PreparedBurst,
    references: &ReferenceFrames,
    motion: &PatchMotion,
    reference: usize,
) -> PatchMotion {
    let variance = burst.matching_variance(reference, references.error_variance);
    let image = |k: usize| &references.pyramids[k].levels[0].image;
    let of = |(k, motion): (usize, &Vec<[f32; 2]>)| {
        if k == reference {
            return motion.clone();
        }
        let images = [image(reference), image(k)];
        refine(images, &burst.grid, motion.iter().copied(), variance)
    };
    motion.par_iter().enumerate().map(of).collect()
}

/// Selects the most likely hypothesis of each patch.
struct HypothesisSelector<'a> {
    burst: &'a PreparedBurst,
    /// Smoothed counts.
    frames: &'a [Frame],
    /// The frames whose counts judge.
    judged: Range<usize>,
    /// The smoothed counts, or the smoothed estimate, of the reference.
    template: &'a Frame,
    settings: Settings,
}

impl HypothesisSelector<'_> {
    /// Selects the hypothesis of every patch; the first of `hypotheses` must be the matched motion.
    fn select_all(&self, reference: usize, hypotheses: &[Hypothesis]) -> PatchMotion {
        let paths: Vec<Vec<[f32; 2]>> = (0..self.burst.grid.len())
            .into_par_iter()
            .map(|i| {
                let path = |motion: &PatchMotion| motion.iter().map(|patches| patches[i]).collect();
                let paths: Vec<(f32, Vec<[f32; 2]>)> =
                    hypotheses.iter().map(|(penalty, motion)| (*penalty, path(motion))).collect();
                self.select(self.burst.grid.corner(i), reference, &paths)
            })
            .collect();
        let frames = 0..self.burst.frames.len();
        frames.map(|k| paths.iter().map(|path| path[k]).collect()).collect()
    }

    /// Selects the most likely path of a patch. Frames that fit it badly keep the displacement of the first
    /// path.
    fn select(
        &self,
        corner: [usize; 2],
        reference: usize,
        paths: &[(f32, Vec<[f32; 2]>)],
    ) -> Vec<[f32; 2]> {
        let costs: Vec<f32> =
            paths.iter().map(|(penalty, path)| penalty + self.cost(corner, path)).collect();
        let best = (0..paths.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
        let mut path = paths[best].1.clone();
        if best == 0 {
            return path;
        }
        let own = self.own(corner.map(|c| c as f32));
        let variance = self.variance(corner);
        let judged = path.iter_mut().enumerate().filter(|(k, _)| self.judged.contains(k));
        for (k, d) in judged.filter(|(k, _)| *k != reference) {
            let matched = paths[0].1[k];
            let [new, old] = [*d, matched].map(|d| {
                let mut sums = Sums::new();
                self.add(&own, k, d, &mut sums);
                sums.misfit(variance, self.settings.outside)
            });
            if new - old >= MAX_EXTRA_MISFIT {
                *d = matched;
            }
        }
        path
    }

    /// Returns the variance of the smoothed counts at the patch.
    fn variance(&self, [x, y]: [usize; 2]) -> f32 {
        let rows = (y..y + SIDE).map(|y| self.template.row(y)[x..x + SIDE].iter().sum::<f32>());
        let mean = rows.sum::<f32>() / (SIDE * SIDE) as f32;
        let variance = self.burst.moments.variance_at_mean(f64::from(mean)) as f32;
        variance.max(1e-4) * REMAINING_VARIANCE * REMAINING_VARIANCE
    }

    /// Computes twice the negative log-likelihood of a path up to a constant, as if pixels were independent.
    fn cost(&self, corner: [usize; 2], path: &[[f32; 2]]) -> f32 {
        let variance = self.variance(corner);
        let margin = ((self.settings.window - 1) * SIDE) as f32 / 2.0;
        let mut cost = 0.0;
        for part in 0..self.settings.window * self.settings.window {
            let part = [part % self.settings.window, part / self.settings.window]
                .map(|k| (k * SIDE) as f32 - margin);
            let own = self.own([corner[0] as f32 + part[0], corner[1] as f32 + part[1]]);
            let mut sums = Sums::new();
            for k in self.judged.clone() {
                self.add(&own, k, path[k], &mut sums);
            }
            cost += sums.misfit(variance, self.settings.outside)
                - common(&sums, self.settings.known, variance);
        }
        cost
    }

    /// Returns the reference's own patch at `corner`.
    fn own(&self, corner: [f32; 2]) -> Own {
        Own { corner, patch: bilinear(self.template, corner) }
    }

    /// Adds the residuals of frame `k`, displaced by `d`, to `sums`.
    fn add(&self, own: &Own, k: usize, d: [f32; 2], sums: &mut Sums) {
        let Own { corner, patch: here } = own;
        let at = [corner[0] + d[0], corner[1] + d[1]];
        let there = bilinear(&self.frames[k], at);
        let size = self.template.size;
        let both = |axis: usize, length: usize| {
            let (a, b) = (inside(corner[axis], length), inside(at[axis], length));
            a.start.max(b.start)..a.end.min(b.end)
        };
        let left = |d: f32| {
            let part = d - d.floor();
            1.0 - 2.0 * part * (1.0 - part) * (1.0 - CORRELATION)
        };
        let noise = left(d[0]) * left(d[1]);
        let (rows, columns) = (both(1, size.height), both(0, size.width));
        let pixels = rows.len() * columns.len();
        if pixels == SIDE * SIDE {
            sums.add_whole(here, &there, noise);
            return;
        }
        sums.outside += (SIDE * SIDE - pixels) as f32;
        for y in rows {
            for x in columns.clone() {
                let residual = there[y][x] - here[y][x];
                sums.sum[y][x] += residual;
                sums.squares[y][x] += residual * residual;
                sums.count[y][x] += 1.0;
                sums.noise[y][x] += noise;
            }
        }
    }
}

/// A patch of the template.
struct Own {
    corner: [f32; 2],
    patch: Patch,
}

/// Sums over the frames of a path of the differences from the template, by pixel.
struct Sums {
    sum: Patch,
    squares: Patch,
    /// Number of frames, per pixel, in which only a part of the patch lies inside the image.
    count: Patch,
    noise: Patch,
    /// Number of frames in which the whole patch lies inside the image.
    whole_count: f32,
    whole_noise: f32,
    /// Number of pixels outside the image, over all frames.
    outside: f32,
}

impl Sums {
    fn new() -> Self {
        let zero = [[0.0; SIDE]; SIDE];
        Self {
            sum: zero,
            squares: zero,
            count: zero,
            noise: zero,
            whole_count: 0.0,
            whole_noise: 0.0,
            outside: 0.0,
        }
    }

    /// Adds the residuals of a frame in which the whole patch lies inside the image.
    fn add_whole(&mut self, here: &Patch, there: &Patch, noise: f32) {
        add_residuals(here, there, &mut self.sum, &mut self.squares);
        self.whole_count += 1.0;
        self.whole_noise += noise;
    }

    /// Returns the sum of squared differences minus its expectation for noise, in units of the noise's
    /// variance.
    fn misfit(&self, variance: f32, outside: f32) -> f32 {
        let noise = total(&self.noise) + self.whole_noise * (SIDE * SIDE) as f32;
        total(&self.squares) / variance - noise + outside * self.outside
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn add_residuals(here: &Patch, there: &Patch, sum: &mut Patch, squares: &mut Patch) {
    for y in 0..SIDE {
        for x in 0..SIDE {
            let residual = there[y][x] - here[y][x];
            sum[y][x] += residual;
            squares[y][x] += residual * residual;
        }
    }
}

/// Returns the part of the misfit that a difference common to all frames explains.
#[multiversion(targets("x86_64+avx2"))]
fn common(sums: &Sums, known: f32, variance: f32) -> f32 {
    let mut common = [[0.0; SIDE]; SIDE];
    for y in 0..SIDE {
        for x in 0..SIDE {
            let weight = 1.0 / (known + sums.whole_count + sums.count[y][x]).max(1.0);
            let noise = sums.whole_noise + sums.noise[y][x];
            common[y][x] = weight * (sums.sum[y][x] * sums.sum[y][x] / variance - noise);
        }
    }
    total(&common)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::block_alignment::BlockAligner;
    use qudi_core::restorer::{Acquisition, BurstView};
    use qudi_core::sensor::{CountLaw, Sensor};
    use qudi_core::{Camera, Light, Size};

    const SIZE: Size = Size { height: 96, width: 112 };

    /// Simulates a window of a moving texture. Returns it with the mean counts of its frames.
    fn burst(ppp: f64, moved: impl Fn(f32) -> [f32; 2]) -> (PreparedBurst, Vec<Frame>) {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let light = Light { ppp, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, SIZE, light, 5).unwrap_or_else(|e| panic!("{e}"));
        let mut counts = Vec::new();
        let mut frames = Vec::new();
        for k in 0..11u8 {
            let [dx, dy] = moved(f32::from(k));
            let scene = Frame::from_fn(SIZE, |x, y| {
                let (x, y) = (x as f32 - dx, y as f32 - dy);
                let wave = (0.31 * x + 0.12 * y).sin() + (0.23 * y - 0.17 * x + 1.0).sin();
                0.45 + 0.04 * wave + 0.03 * (0.41 * (x - y)).cos()
            });
            counts.push(camera.expose(u64::from(k), &[&scene]).unwrap_or_else(|e| panic!("{e}")));
            frames.push(scene);
        }
        let gain = camera.gain();
        let acquisition = Acquisition::new(sensor, ppp, 0.45).unwrap_or_else(|e| panic!("{e}"));
        let burst = PreparedBurst::new(BurstView { size: SIZE, frames: &counts }, &acquisition);
        let law = CountLaw::new(&acquisition.sensor, gain);
        let dark = acquisition.sensor.dark_per_frame().unwrap_or_else(|e| panic!("{e}"));
        let light = acquisition.sensor.quantum_efficiency * ppp / 0.45;
        for value in frames.iter_mut().flat_map(|frame| &mut frame.data) {
            *value = law.mean(light * f64::from(*value) + dark) as f32;
        }
        (burst, frames)
    }

    /// Returns the mean end-point error of the flow from frame 5 to all others, over patches off the border.
    fn error(burst: &PreparedBurst, motion: &PatchMotion, moved: impl Fn(f32) -> [f32; 2]) -> f32 {
        let mut errors = Vec::new();
        for (k, patches) in motion.iter().enumerate() {
            let [from, to] = [5.0, k as f32].map(&moved);
            for (i, d) in patches.iter().enumerate() {
                let [x, y] = burst.grid.corner(i);
                if (24..64).contains(&x) && (24..56).contains(&y) {
                    errors.push((d[0] - to[0] + from[0]).hypot(d[1] - to[1] + from[1]));
                }
            }
        }
        errors.iter().sum::<f32>() / errors.len() as f32
    }

    fn velocity(burst: &PreparedBurst) -> ConstantVelocity {
        ConstantVelocity::find(burst, 0.0).unwrap_or_else(|| panic!("enough frames"))
    }

    #[test]
    fn faint_texture_follows_the_motion_of_all_frames() {
        let moved = |t: f32| [1.7 * t, -0.9 * t];
        let (burst, _) = burst(3.25, moved);
        let all = 0..burst.frames.len();
        let (_, matched) = BlockAligner::new(&burst, 1).align(&burst, 5, &all);
        let before = error(&burst, &matched, moved);
        let velocity = Some(velocity(&burst));
        let matched = (0.0, matched);
        let selected = select_on_counts(&burst, velocity.as_ref(), None, 5, &all, matched);
        let after = error(&burst, &selected, moved);
        assert!(after < 0.5 * before, "{before} before, {after} px after");
    }

    /// Checks that the matched motion is kept with enough light and good reference frames.
    #[test]
    fn keeps_matched_motion_where_it_accelerates() {
        let moved = |t: f32| [0.25 * (t - 5.0) * (t - 5.0), 0.0];
        let (burst, frames) = burst(100.0, moved);
        let references = ReferenceFrames::new(&burst, frames, 0.1);
        let matched = references.align(&burst, 5);
        let before = error(&burst, &matched, moved);
        let selected =
            select_on_estimates(&burst, Some(&velocity(&burst)), &references, 5, matched);
        let after = error(&burst, &selected, moved);
        assert!(before < 0.3 && after < before + 0.05, "{before} before, {after} px after");
    }

    /// Checks that noise does not move patches of a static scene. Its reference frames hold a fifth of their
    /// frames' counts, smoothed, so that matching follows the same noise that judges the hypotheses.
    #[test]
    fn noise_in_reference_frames_does_not_move_patches() {
        let moved = |_: f32| [0.0, 0.0];
        let (burst, mut frames) = burst(3.25, moved);
        let noise: Vec<Frame> = burst.frames.iter().map(|frame| smooth(&smooth(frame))).collect();
        for (frame, counts) in frames.iter_mut().zip(&noise) {
            for (value, count) in frame.data.iter_mut().zip(&counts.data) {
                *value += 0.2 * (count - *value);
            }
        }
        let references = ReferenceFrames::new(&burst, frames, 0.1);
        let references = ReferenceFrames { global_motion: None, ..references };
        let matched = references.align(&burst, 5);
        let before = error(&burst, &matched, moved);
        let selected =
            select_on_estimates(&burst, Some(&velocity(&burst)), &references, 5, matched);
        let after = error(&burst, &selected, moved);
        assert!(after < 0.1 * before, "{before} before, {after} px after");
    }
}
