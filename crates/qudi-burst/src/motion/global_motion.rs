//! The camera's own motion: what most of the image does together, however unevenly.
//!
//! A patch of a few photons says little of its motion, the whole image a lot. Squares of the image vote on
//! the shift from each frame to the next; then affine maps are found that lay all frames upon the mean of the
//! others, which is far less noisy than any of them.

use super::affine::{Affine, Freedom, centre};
use super::pyramid::{shrink, smooth};
use super::velocity_search::lowest_between;
use qudi_core::sensor::CountMoments;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Pixels of the frames along a side of a pixel where squares vote.
const VOTES: usize = 4;

/// The same where frames are registered, coarse to fine, and what is found there. The first is coarser than
/// that of the votes, which are wrong by some pixels where something else has more contrast.
const LEVELS: [(usize, Freedom); 3] =
    [(8, Freedom::Shift), (4, Freedom::Shift), (2, Freedom::Affine)];

/// Farthest shift from one frame to the next, in pixels of the votes' level, and shifts along each axis.
const FARTHEST: isize = 8;
const ACROSS: isize = 2 * FARTHEST + 1;

/// Least side of that level.
const SMALLEST: usize = 12;

/// Side of the squares that vote, in the same, and nats that each has at most.
const VOTER: usize = 5;
const MOST: f32 = 8.0;

/// Times that the mean of the others is made anew on each level, and steps towards it each time.
const ROUNDS: usize = 3;
const STEPS: usize = 2;

/// The motion of a whole window: one affine map from the middle frame to each frame.
#[derive(Clone, Debug)]
pub(crate) struct GlobalMotion {
    centre: [f32; 2],
    /// From where the middle frame is, about, to each.
    maps: Vec<Affine>,
}

impl GlobalMotion {
    /// Of a window's frames of mean counts, whose errors are `error` times the variance of counts; nothing if
    /// frames are too few or too small to tell.
    pub(crate) fn find(frames: &[Frame], moments: &CountMoments, error: f32) -> Option<Self> {
        let whole = frames.first()?.size;
        let size = Size { height: whole.height / VOTES, width: whole.width / VOTES };
        if frames.len() < 3 || size.height.min(size.width) < SMALLEST {
            return None;
        }
        let small: Vec<Frame> = frames.par_iter().map(|frame| shrink(frame, size, VOTES)).collect();
        let share = 1.0 / small.len() as f32;
        let variance = Frame::from_fn(size, |x, y| {
            let mean = share * small.iter().map(|frame| frame.row(y)[x]).sum::<f32>();
            let variance = moments.variance_at_mean(f64::from(mean)) as f32;
            error * variance.max(1e-4) / (VOTES * VOTES) as f32
        });
        let shifts: Vec<[f32; 2]> =
            small.windows(2).map(|pair| shift(&pair[0], &pair[1], &variance)).collect();
        let middle = frames.len() / 2;
        let sum = |k: usize| {
            let (range, sign) = if k < middle { (k..middle, -1.0) } else { (middle..k, 1.0) };
            let along =
                |axis: usize| shifts[range.clone()].iter().map(|shift| shift[axis]).sum::<f32>();
            [0, 1].map(|axis| sign * along(axis))
        };
        let mut maps: Vec<Affine> = (0..frames.len()).map(|k| Affine::shift(sum(k))).collect();
        let mut last = VOTES;
        for (ratio, freedom) in LEVELS {
            let times = last as f32 / ratio as f32;
            maps = maps.into_iter().map(|map| map.finer(times)).collect();
            let size = Size { height: whole.height / ratio, width: whole.width / ratio };
            let level = frames.par_iter().map(|frame| smooth(&shrink(frame, size, ratio)));
            let level: Vec<Frame> = level.collect();
            for _ in 0..ROUNDS {
                maps = registered(&level, &maps, freedom);
            }
            last = ratio;
        }
        let maps = maps.into_iter().map(|map| map.finer(last as f32)).collect();
        Some(Self { centre: centre(whole), maps })
    }

    /// By how much what is at `place` of frame `reference` is displaced in frame `k`, in pixels, right and
    /// down.
    pub(crate) fn displacement(&self, place: [f32; 2], reference: usize, k: usize) -> [f32; 2] {
        let from = [place[0] - self.centre[0], place[1] - self.centre[1]];
        let to = self.maps[k].of(self.maps[reference].inverse_of(from));
        [to[0] - from[0], to[1] - from[1]]
    }
}

/// The shift that most of the image agrees on, to a part of a pixel. Squares vote, each by the likelihood of
/// its counts, but within limits: what has much contrast and moves otherwise must not outvote the rest.
fn shift(here: &Frame, there: &Frame, variance: &Frame) -> [f32; 2] {
    let shifts: Vec<[isize; 2]> = (0..ACROSS * ACROSS)
        .map(|label| [label % ACROSS - FARTHEST, label / ACROSS - FARTHEST])
        .collect();
    let costs: Vec<f32> =
        shifts.par_iter().map(|&shift| cost([here, there, variance], shift)).collect();
    // Of what nothing tells apart, the least.
    let length = |label: usize| shifts[label].map(|d| d * d).iter().sum::<isize>();
    let order = |&a: &usize, &b: &usize| {
        costs[a].total_cmp(&costs[b]).then_with(|| length(a).cmp(&length(b)))
    };
    let best = (0..costs.len()).min_by(order).unwrap_or(0);
    let along = |place: usize, step: usize| {
        let whole = place as f32 - FARTHEST as f32;
        if place == 0 || place + 1 == ACROSS as usize {
            return whole;
        }
        whole + lowest_between([costs[best - step], costs[best], costs[best + step]])
    };
    let across = ACROSS as usize;
    [along(best % across, 1), along(best / across, across)]
}

/// Nats that a shift costs, mean of all squares within both images; infinite if those are few.
fn cost([here, there, variance]: [&Frame; 3], [dx, dy]: [isize; 2]) -> f32 {
    let Size { height, width } = here.size;
    let range = |d: isize, length: usize| {
        d.min(0).unsigned_abs()..length.saturating_sub(d.max(0).unsigned_abs())
    };
    let (rows, columns) = (range(dy, height), range(dx, width));
    let mut sums = vec![0.0f32; columns.len() / VOTER];
    let (mut sum, mut voters) = (0.0, 0);
    for (n, y) in rows.enumerate() {
        let start = columns.start.wrapping_add_signed(dx);
        let there = &there.row(y.wrapping_add_signed(dy))[start..start + columns.len()];
        let here = here.row(y)[columns.clone()].iter();
        let squares = here.zip(there).zip(&variance.row(y)[columns.clone()]);
        let squares: Vec<f32> = squares.map(|((a, b), v)| (a - b) * (a - b) / (4.0 * v)).collect();
        for (sum, squares) in sums.iter_mut().zip(squares.chunks_exact(VOTER)) {
            *sum += squares.iter().sum::<f32>();
        }
        if n % VOTER == VOTER - 1 {
            let noise = 0.5 * (VOTER * VOTER) as f32;
            sum += sums.iter().map(|square| (square - noise).min(MOST)).sum::<f32>();
            voters += sums.len();
            sums.fill(0.0);
        }
    }
    let all = (height / VOTER) * (width / VOTER);
    if 5 * voters < 2 * all { f32::INFINITY } else { sum / voters as f32 }
}

/// Every frame a little closer to the mean of the others (Baker and Matthews, "Lucas-Kanade 20 years on",
/// IJCV 56(3), 2004, but with a template that all frames make).
fn registered(frames: &[Frame], maps: &[Affine], freedom: Freedom) -> Vec<Affine> {
    let size = frames[0].size;
    let aligned: Vec<Vec<f32>> =
        frames.par_iter().zip(maps).map(|(f, map)| map.aligned(f)).collect();
    let mut sums = vec![[0.0f32; 2]; size.pixels()];
    for frame in &aligned {
        for (sum, value) in sums.iter_mut().zip(frame).filter(|(_, value)| value.is_finite()) {
            *sum = [sum[0] + value, sum[1] + 1.0];
        }
    }
    let moved = |(k, (frame, map)): (usize, (&Frame, &Affine))| {
        let others = sums.iter().zip(&aligned[k]).map(|([sum, count], value)| {
            let own = if value.is_finite() { [*value, 1.0] } else { [0.0; 2] };
            let count = count - own[1];
            if count > 0.5 { (sum - own[0]) / count } else { f32::NAN }
        });
        let others: Vec<f32> = others.collect();
        let Some(mut map) = map.stepped(&aligned[k], &others, size, freedom) else { return *map };
        for _ in 1..STEPS {
            let Some(next) = map.stepped(&map.aligned(frame), &others, size, freedom) else {
                break;
            };
            map = next;
        }
        map
    };
    frames.par_iter().zip(maps).enumerate().map(moved).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use qudi_core::sensor::{CountLaw, Sensor};
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    const SIZE: Size = Size { height: 112, width: 144 };

    /// Texture of mean 2 without a period.
    fn texture(x: f32, y: f32) -> f32 {
        let wave = |i: u8| {
            let i = f32::from(i);
            let (turn, slope) = (2.4 * i, 0.08 + 0.023 * i);
            (slope * (turn.cos() * x + turn.sin() * y) + i * i).sin()
        };
        2.0 + 0.25 * (0..16).map(wave).sum::<f32>()
    }

    fn moments() -> CountMoments {
        let sensor = Sensor::load("qudi-paper").unwrap();
        CountMoments::new(&CountLaw::new(&sensor, sensor.gain_at(3.25).unwrap()))
    }

    /// Where the camera looks, in pixels, unevenly; and by how much it is nearer.
    const PATH: [[f32; 3]; 7] = [
        [-21.0, 4.0, 0.98],
        [-16.0, 1.5, 0.985],
        [-5.0, -0.5, 0.99],
        [0.0, 0.0, 1.0],
        [9.5, 0.5, 1.0],
        [14.0, 3.0, 1.01],
        [26.0, 3.5, 1.02],
    ];

    /// Frames whose counts vary as photons do, about; a dark square of a tenth of the image stays where it
    /// is.
    fn frames(moments: &CountMoments) -> Vec<Frame> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let [cx, cy] = centre(SIZE);
        let frame = |[u, v, zoom]: &[f32; 3]| {
            Frame::from_fn(SIZE, |x, y| {
                let (a, b) = (x as f32 - cx, y as f32 - cy);
                let mean = match (x / 24, y / 24) {
                    (2..=3, 1..=2) => 0.4,
                    _ => texture((a - u) / zoom, (b - v) / zoom),
                };
                let half = (3.0 * moments.variance_at_mean(f64::from(mean))).sqrt() as f32;
                mean + rng.random_range(-half..half)
            })
        };
        PATH.iter().map(frame).collect()
    }

    #[test]
    fn majority_decides_and_uneven_motion_is_detected() {
        let moments = moments();
        let camera = GlobalMotion::find(&frames(&moments), &moments, 1.0).unwrap();
        let [cx, cy] = centre(SIZE);
        for (reference, k) in [(3, 0), (3, 6), (1, 5), (6, 2), (4, 4)] {
            let [from, to] = [PATH[reference], PATH[k]];
            for place in [[15.0, 20.0], [130.0, 12.0], [125.0, 100.0]] {
                let scene =
                    [(place[0] - cx - from[0]) / from[2], (place[1] - cy - from[1]) / from[2]];
                let there = [scene[0] * to[2] + to[0] + cx, scene[1] * to[2] + to[1] + cy];
                let found = camera.displacement(place, reference, k);
                for axis in 0..2 {
                    let error = found[axis] - (there[axis] - place[axis]);
                    assert!(error.abs() < 1.0, "{reference} to {k} at {place:?}: {error}");
                }
            }
        }
    }

    #[test]
    fn motion_is_zero_without_texture() {
        let moments = moments();
        let flat = vec![Frame::filled(SIZE, 1.0); 5];
        let camera = GlobalMotion::find(&flat, &moments, 1.0).unwrap();
        let moved = camera.displacement([10.0, 90.0], 0, 4);
        assert!(moved.iter().all(|d| d.abs() < 1e-3), "{moved:?}");
        assert!(GlobalMotion::find(&flat[..2], &moments, 1.0).is_none());
        let small = Frame::filled(Size { height: 47, width: 300 }, 1.0);
        assert!(GlobalMotion::find(&vec![small; 5], &moments, 1.0).is_none());
    }
}
