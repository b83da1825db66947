//! Which way a patch goes through the window: as it was matched frame by frame, or evenly, as all frames' counts agree.
//!
//! Matching a guide on itself repeats the guide's errors: what it lost cannot be matched, and what it made up moves as it was
//! merged. Counts are independent from frame to frame. Paths are judged by the likelihood of all frames' counts: the patch
//! is what the guide expects of the reference plus something unknown, the same in all frames, plus noise.

use super::align::{refined, sample};
use super::grid::{Grid, inside};
use super::pyramid::smooth;
use super::velocity::Coarse;
use crate::merge::dft::{Patch, SIDE};
use crate::methods::qbp::{Merger, Patchwise};
use qudi_core::Frame;
use rayon::prelude::*;

/// Variance of one frame's noise in that of the guide's errors, both smoothed: what the first guide is taken for, and nothing
/// known at first.
const KNOWN: [f32; 2] = [0.0, 6.0];

/// Side of the windows that judge before there is a guide, in patches, and then.
const WINDOW: [usize; 2] = [2, 1];

/// By how much a frame may fit worse on a chosen path, in noise's variances: else something came in between.
const WORSE: f32 = 100.0;

/// Prices of paths once there are pilots, in the same. Pilots hold the noise of the counts that judge paths found in them, and
/// the more freely one was found, the more of that noise it fits: then noise is merged with itself.
mod price {
    pub(crate) const MATCHED: f32 = 200.0;
    pub(crate) const EVEN: f32 = 200.0;
    pub(crate) const EVEN_REFINED: f32 = 150.0;
    pub(crate) const CAMERA_REFINED: f32 = 100.0;
    pub(crate) const CAMERA: f32 = 0.0;
    pub(crate) const REST: f32 = 0.0;
}

/// Price of each pixel that leaves the image, in the same, before there is a guide and then.
const OUTSIDE: [f32; 2] = [10.0, 0.1];

/// Frames from one whose velocities are searched to the next; the others' follow from these.
const ANCHORS: usize = 6;

/// Variance that smoothing leaves of white noise along a side, and the correlation of neighbours after it.
const LEFT: f32 = 70.0 / 256.0;
const CORRELATION: f32 = 0.8;

/// What the counts of a window say of motion by themselves.
#[derive(Debug)]
pub(crate) struct Even {
    /// Counts, smoothed.
    frames: Vec<Frame>,
    /// Velocities of the patches of every frame, `[frame][patch]`.
    velocities: Patchwise,
}

impl Even {
    /// Of a merger's window; nothing if there are too few frames to agree.
    pub(crate) fn find(merger: &Merger) -> Option<Self> {
        let frames = &merger.frames;
        if frames.len() < 3 {
            return None;
        }
        let coarse = Coarse::new(frames, &merger.moments);
        let grid = &merger.grid;
        let anchors = ((frames.len() - 1) % ANCHORS / 2..frames.len()).step_by(ANCHORS);
        let found: Vec<_> = anchors.map(|k| (k, coarse.velocities(grid, k))).collect();
        let of = |frame: usize| {
            let (anchor, velocities) = found.iter().min_by_key(|(k, _)| k.abs_diff(frame))?;
            let time = *anchor as f32 - frame as f32;
            Some((0..grid.len()).map(|i| carried(grid, velocities, i, time)).collect())
        };
        let velocities = (0..frames.len()).map(of).collect::<Option<_>>()?;
        Some(Self { frames: frames.par_iter().map(smooth).collect(), velocities })
    }
}

/// The velocity of patch `i` from those of the patches `time` frames later: of the one that even motion takes it to.
fn carried(grid: &Grid, velocities: &[[f32; 2]], i: usize, time: f32) -> [f32; 2] {
    let centre = grid.corner(i).map(|corner| (corner + grid.side / 2) as f32);
    let mut v = velocities[i];
    for _ in 0..2 {
        let there = [centre[0] + time * v[0], centre[1] + time * v[1]];
        v = velocities[grid.around(there)[0]];
    }
    v
}

impl Merger {
    /// For every patch the likeliest of the paths in `flow`, of even motion and of the camera's; once there are pilots, of both
    /// refined on these, and of rest, too. Nothing where even motion was not looked for.
    pub(crate) fn likeliest(&self, reference: usize, flow: &Patchwise) -> Option<Patchwise> {
        let even = self.even.as_ref()?;
        let count = self.frames.len();
        let choices = self.choices(even, reference, flow);
        let pilot = self.pilots.as_ref().map(|pilots| smooth(&pilots.frames[reference]));
        let stage = usize::from(pilot.is_some());
        let judge = Judge {
            merger: self,
            frames: &even.frames,
            template: pilot.as_ref().unwrap_or(&even.frames[reference]),
            known: KNOWN[stage],
            outside: OUTSIDE[stage],
            window: WINDOW[stage],
        };
        let paths: Vec<Vec<[f32; 2]>> = (0..self.grid.len())
            .into_par_iter()
            .map(|i| {
                let path = |choice: &Patchwise| choice.iter().map(|patches| patches[i]).collect();
                let paths: Vec<(f32, Vec<[f32; 2]>)> =
                    choices.iter().map(|(price, choice)| (*price, path(choice))).collect();
                judge.likeliest(self.grid.corner(i), reference, &paths)
            })
            .collect();
        Some((0..count).map(|k| paths.iter().map(|path| path[k]).collect()).collect())
    }

    /// Paths to choose among, and what they cost beforehand; what was matched comes first.
    fn choices(&self, even: &Even, reference: usize, flow: &Patchwise) -> Vec<(f32, Patchwise)> {
        let flow = flow.clone();
        let count = self.frames.len();
        let time = |k: usize| k as f32 - reference as f32;
        let velocities = &even.velocities[reference];
        let straight: Patchwise = (0..count)
            .map(|k| velocities.iter().map(|v| v.map(|v| v * time(k))).collect())
            .collect();
        let camera = self.camera.as_ref().map(|camera| {
            let half = 0.5 * (SIDE - 1) as f32;
            let centres: Vec<[f32; 2]> = (0..self.grid.len())
                .map(|i| self.grid.corner(i).map(|corner| corner as f32 + half))
                .collect();
            let path =
                |k| centres.iter().map(|&at| camera.displacement(at, reference, k)).collect();
            (0..count).map(path).collect::<Patchwise>()
        });
        if self.pilots.is_none() {
            return [flow, straight].into_iter().chain(camera).map(|path| (0.0, path)).collect();
        }
        let rest = vec![vec![[0.0; 2]; self.grid.len()]; count];
        let refined = self.refined(&straight, reference);
        let mut choices = vec![
            (price::MATCHED, flow),
            (price::EVEN, straight),
            (price::EVEN_REFINED, refined),
            (price::REST, rest),
        ];
        if let Some(path) = camera {
            choices.push((price::CAMERA_REFINED, self.refined(&path, reference)));
            choices.push((price::CAMERA, path));
        }
        choices
    }

    /// Displacements refined on the pilots.
    fn refined(&self, flow: &Patchwise, reference: usize) -> Patchwise {
        let variance = self.matching_variance(reference);
        let image = |k: usize| &self.pyramids[k].levels[0].image;
        let of = |(k, flow): (usize, &Vec<[f32; 2]>)| {
            if k == reference {
                return flow.clone();
            }
            let images = [image(reference), image(k)];
            refined(images, &self.grid, flow.iter().copied(), variance)
        };
        flow.par_iter().enumerate().map(of).collect()
    }
}

/// Says what paths are worth.
struct Judge<'a> {
    merger: &'a Merger,
    frames: &'a [Frame],
    /// What the reference is taken for, smoothed.
    template: &'a Frame,
    known: f32,
    outside: f32,
    window: usize,
}

impl Judge<'_> {
    /// The likeliest path, and where a frame denies it the first one.
    fn likeliest(
        &self,
        corner: [usize; 2],
        reference: usize,
        paths: &[(f32, Vec<[f32; 2]>)],
    ) -> Vec<[f32; 2]> {
        let costs: Vec<f32> =
            paths.iter().map(|(price, path)| price + self.cost(corner, path)).collect();
        let best = (0..paths.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
        let mut path = paths[best].1.clone();
        if best == 0 {
            return path;
        }
        let own = self.own(corner.map(|c| c as f32));
        let variance = self.variance(corner);
        for (k, d) in path.iter_mut().enumerate().filter(|(k, _)| *k != reference) {
            let first = paths[0].1[k];
            let [new, old] = [*d, first].map(|d| {
                let mut sums = Sums::new();
                self.add(&own, k, d, &mut sums);
                sums.misfit(variance, self.outside)
            });
            if new - old >= WORSE {
                *d = first;
            }
        }
        path
    }

    /// Variance of the smoothed counts where the patch lies.
    fn variance(&self, [x, y]: [usize; 2]) -> f32 {
        let rows = (y..y + SIDE).map(|y| self.template.row(y)[x..x + SIDE].iter().sum::<f32>());
        let mean = rows.sum::<f32>() / (SIDE * SIDE) as f32;
        let variance = self.merger.moments.variance_at_mean(f64::from(mean)) as f32;
        variance.max(1e-4) * LEFT * LEFT
    }

    /// Twice the negative logarithm of the likelihood but for a constant, as if pixels were independent.
    fn cost(&self, corner: [usize; 2], path: &[[f32; 2]]) -> f32 {
        let variance = self.variance(corner);
        let margin = ((self.window - 1) * SIDE) as f32 / 2.0;
        let mut cost = 0.0;
        for part in 0..self.window * self.window {
            let part = [part % self.window, part / self.window].map(|k| (k * SIDE) as f32 - margin);
            let own = self.own([corner[0] as f32 + part[0], corner[1] as f32 + part[1]]);
            let mut sums = Sums::new();
            for (k, &d) in path.iter().enumerate() {
                self.add(&own, k, d, &mut sums);
            }
            cost += sums.misfit(variance, self.outside) - sums.common(self.known, variance);
        }
        cost
    }

    /// The reference's own patch at `corner`.
    fn own(&self, corner: [f32; 2]) -> Own {
        Own { corner, patch: sample(self.template, corner) }
    }

    /// Adds what frame `k`, displaced by `d`, has in a patch.
    fn add(&self, own: &Own, k: usize, d: [f32; 2], sums: &mut Sums) {
        let Own { corner, patch: here } = own;
        let at = [corner[0] + d[0], corner[1] + d[1]];
        let there = sample(&self.frames[k], at);
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
        sums.outside += (SIDE * SIDE - rows.len() * columns.len()) as f32;
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

/// A patch of what the reference is taken for.
struct Own {
    corner: [f32; 2],
    patch: Patch,
}

/// Sums over the frames of a path of what differs from the template, by pixel.
struct Sums {
    sum: [[f32; SIDE]; SIDE],
    squares: [[f32; SIDE]; SIDE],
    count: [[f32; SIDE]; SIDE],
    /// Variances of the noise, in that of a whole pixel.
    noise: [[f32; SIDE]; SIDE],
    /// Pixels of frames that lie outside.
    outside: f32,
}

impl Sums {
    fn new() -> Self {
        let zero = [[0.0; SIDE]; SIDE];
        Self { sum: zero, squares: zero, count: zero, noise: zero, outside: 0.0 }
    }

    /// Squared differences over what noise makes.
    fn misfit(&self, variance: f32, outside: f32) -> f32 {
        let squares: f32 = self.squares.iter().flatten().sum();
        let noise: f32 = self.noise.iter().flatten().sum();
        squares / variance - noise + outside * self.outside
    }

    /// As much of it as a difference common to all frames explains.
    fn common(&self, known: f32, variance: f32) -> f32 {
        let mut common = 0.0;
        for y in 0..SIDE {
            for x in 0..SIDE {
                let weight = 1.0 / (known + self.count[y][x]).max(1.0);
                common += weight * (self.sum[y][x] * self.sum[y][x] / variance - self.noise[y][x]);
            }
        }
        common
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::qbp::Pilots;
    use qudi_core::restorer::{Acquisition, BurstView};
    use qudi_core::sensor::{CountLaw, Sensor};
    use qudi_core::{Camera, Light, Size};

    const SIZE: Size = Size { height: 96, width: 112 };

    /// A window of a texture that moves, its merger, and what the merger takes for the truth.
    fn merger(ppp: f64, moved: impl Fn(f32) -> [f32; 2]) -> (Merger, Pilots) {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let light = Light { ppp, exposure: 0.45 };
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
        let acquisition =
            Acquisition { seed: 0, first_frame: 0, ppp, exposure: 0.45, sensor, gain, dark: None };
        let burst = BurstView { size: SIZE, frames: &counts };
        let mut merger = Merger::new(burst, &acquisition, 1, 16.0);
        merger.even = Even::find(&merger);
        let law = CountLaw::new(&acquisition.sensor, gain);
        let dark = acquisition.sensor.dark_per_frame().unwrap_or_else(|e| panic!("{e}"));
        let light = acquisition.sensor.quantum_efficiency * ppp / 0.45;
        for value in frames.iter_mut().flat_map(|frame| &mut frame.data) {
            *value = law.mean(light * f64::from(*value) + dark) as f32;
        }
        (merger, Pilots { frames, error: 0.1 })
    }

    /// Mean distance from the truth of the flow from frame 5 to all others, of patches off the border.
    fn error(merger: &Merger, flow: &Patchwise, moved: impl Fn(f32) -> [f32; 2]) -> f32 {
        let mut errors = Vec::new();
        for (k, patches) in flow.iter().enumerate() {
            let [from, to] = [5.0, k as f32].map(&moved);
            for (i, d) in patches.iter().enumerate() {
                let [x, y] = merger.grid.corner(i);
                if (24..64).contains(&x) && (24..56).contains(&y) {
                    errors.push((d[0] - to[0] + from[0]).hypot(d[1] - to[1] + from[1]));
                }
            }
        }
        errors.iter().sum::<f32>() / errors.len() as f32
    }

    #[test]
    fn faint_texture_follows_what_all_frames_agree_on() {
        let moved = |t: f32| [1.7 * t, -0.9 * t];
        let (merger, _) = merger(3.25, moved);
        let before = merger.matched(5).1;
        let before = error(&merger, &before, moved);
        let after = error(&merger, &merger.flow(5).1, moved);
        assert!(after < 0.5 * before, "{before} before, {after} px after");
    }

    /// With light and good pilots matching is right, and motion that is not even stays as it was matched.
    #[test]
    fn uneven_motion_stays_as_it_was_matched() {
        let moved = |t: f32| [0.25 * (t - 5.0) * (t - 5.0), 0.0];
        let (mut merger, pilots) = merger(100.0, moved);
        merger.follow(pilots);
        let before = merger.matched(5).1;
        let before = error(&merger, &before, moved);
        let after = error(&merger, &merger.flow(5).1, moved);
        assert!(before < 0.3 && after < before + 0.05, "{before} before, {after} px after");
    }

    /// Pilots of a scene at rest that hold a fifth of their frames' counts, smoothed: matching follows the noise of these,
    /// which judges paths, too.
    #[test]
    fn noise_that_pilots_hold_does_not_move_them() {
        let moved = |_: f32| [0.0, 0.0];
        let (mut merger, mut pilots) = merger(3.25, moved);
        let smooth = |k: usize| smooth(&smooth(&merger.frames[k]));
        let noise: Vec<Frame> = (0..11).map(smooth).collect();
        for (pilot, counts) in pilots.frames.iter_mut().zip(&noise) {
            for (value, count) in pilot.data.iter_mut().zip(&counts.data) {
                *value += 0.2 * (count - *value);
            }
        }
        merger.follow(pilots);
        merger.camera = None;
        let before = merger.matched(5).1;
        let before = error(&merger, &before, moved);
        let after = error(&merger, &merger.flow(5).1, moved);
        assert!(after < 0.1 * before, "{before} before, {after} px after");
    }

    #[test]
    fn velocities_are_carried_along_their_own_motion() {
        let grid = Grid::new(SIZE, SIDE, SIDE / 2);
        // The left half moves right, two pixels per frame, the right half rests.
        let border = |x: usize| if x < 48 { [2.0, 0.0] } else { [0.0, 0.0] };
        let velocities: Vec<[f32; 2]> =
            (0..grid.len()).map(|i| border(grid.corner(i)[0])).collect();
        for i in 0..grid.len() {
            let [x, _] = grid.corner(i);
            let found = carried(&grid, &velocities, i, 2.0);
            // Four pixels on, a patch within two of the border has crossed it.
            if x < 40 {
                assert_eq!(found, [2.0, 0.0]);
            } else if x > 48 {
                assert_eq!(found, [0.0, 0.0]);
            }
        }
    }
}
