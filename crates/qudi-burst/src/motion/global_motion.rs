//! Global motion: the common motion of most of the image, caused by the camera.
//!
//! A patch of a few photons tells little about its motion, but the whole image tells a lot. Squares of the
//! image vote on the shift from each frame to the next. Affine maps then align every frame with the mean of
//! the others, which has much less noise than a single frame.

use super::affine::{Affine, Freedom, centre};
use super::pyramid::{shrink, smooth};
use super::velocity_search::lowest_between;
use qudi_core::sensor::CountMoments;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Factor by which frames are shrunk for the vote.
const VOTE_SHRINK: usize = 4;

/// Shrink factors and motion models of registration, from coarse to fine. The first level is coarser than the
/// vote's, because votes can be wrong by a few pixels where another motion has more contrast.
const LEVELS: [(usize, Freedom); 3] =
    [(8, Freedom::Shift), (4, Freedom::Shift), (2, Freedom::Affine)];

/// Maximum shift from one frame to the next, in pixels of the vote's level.
const MAX_SHIFT: isize = 8;
/// Number of shifts along each axis.
const SHIFTS_PER_AXIS: isize = 2 * MAX_SHIFT + 1;

/// Minimum side of the vote's level, in pixels.
const MIN_SIDE: usize = 12;

/// Side of a voting square, in pixels of the vote's level.
const VOTER_SIDE: usize = 5;
/// Upper bound of a square's vote, in nats.
const MAX_VOTE: f32 = 8.0;

/// Number of rounds per level. Each round computes the mean of the other frames again.
const ROUNDS: usize = 3;
/// Gauss-Newton steps per round.
const STEPS: usize = 2;

/// Motion of a whole window: one affine map from the middle frame to each frame.
#[derive(Clone, Debug)]
pub(crate) struct GlobalMotion {
    centre: [f32; 2],
    /// Maps from an approximate middle frame to each frame.
    maps: Vec<Affine>,
}

impl GlobalMotion {
    /// Estimates the motion of a window's mean counts, whose errors have `error` times the variance of
    /// counts. Returns `None` if there are too few frames or they are too small.
    pub(crate) fn find(frames: &[Frame], moments: &CountMoments, error: f32) -> Option<Self> {
        let whole = frames.first()?.size;
        let size = Size { height: whole.height / VOTE_SHRINK, width: whole.width / VOTE_SHRINK };
        if frames.len() < 3 || size.height.min(size.width) < MIN_SIDE {
            return None;
        }
        let small: Vec<Frame> =
            frames.par_iter().map(|frame| shrink(frame, size, VOTE_SHRINK)).collect();
        let share = 1.0 / small.len() as f32;
        let variance = Frame::from_fn(size, |x, y| {
            let mean = share * small.iter().map(|frame| frame.row(y)[x]).sum::<f32>();
            let variance = moments.variance_at_mean(f64::from(mean)) as f32;
            error * variance.max(1e-4) / (VOTE_SHRINK * VOTE_SHRINK) as f32
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
        let mut last = VOTE_SHRINK;
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

    /// Returns the displacement to frame `k` of the point at `place` in frame `reference`, in pixels, right
    /// and down.
    pub(crate) fn displacement(&self, place: [f32; 2], reference: usize, k: usize) -> [f32; 2] {
        let from = [place[0] - self.centre[0], place[1] - self.centre[1]];
        let to = self.maps[k].of(self.maps[reference].inverse_of(from));
        [to[0] - from[0], to[1] - from[1]]
    }
}

/// Estimates the shift that most of the image agrees on, with subpixel precision. Each square votes with the
/// likelihood of its counts, up to a bound, so that a moving object of high contrast does not outvote the
/// rest.
fn shift(here: &Frame, there: &Frame, variance: &Frame) -> [f32; 2] {
    let shifts: Vec<[isize; 2]> = (0..SHIFTS_PER_AXIS * SHIFTS_PER_AXIS)
        .map(|label| [label % SHIFTS_PER_AXIS - MAX_SHIFT, label / SHIFTS_PER_AXIS - MAX_SHIFT])
        .collect();
    let costs: Vec<f32> =
        shifts.par_iter().map(|&shift| cost([here, there, variance], shift)).collect();
    // Of equally likely shifts, the smallest is chosen.
    let length = |label: usize| shifts[label].map(|d| d * d).iter().sum::<isize>();
    let order = |&a: &usize, &b: &usize| {
        costs[a].total_cmp(&costs[b]).then_with(|| length(a).cmp(&length(b)))
    };
    let best = (0..costs.len()).min_by(order).unwrap_or(0);
    let along = |place: usize, step: usize| {
        let whole = place as f32 - MAX_SHIFT as f32;
        if place == 0 || place + 1 == SHIFTS_PER_AXIS as usize {
            return whole;
        }
        whole + lowest_between([costs[best - step], costs[best], costs[best + step]])
    };
    let across = SHIFTS_PER_AXIS as usize;
    [along(best % across, 1), along(best / across, across)]
}

/// Computes the cost of a shift in nats, averaged over all squares inside both images. It is infinite if
/// there are too few squares.
fn cost([here, there, variance]: [&Frame; 3], [dx, dy]: [isize; 2]) -> f32 {
    let Size { height, width } = here.size;
    let range = |d: isize, length: usize| {
        d.min(0).unsigned_abs()..length.saturating_sub(d.max(0).unsigned_abs())
    };
    let (rows, columns) = (range(dy, height), range(dx, width));
    let mut sums = vec![0.0f32; columns.len() / VOTER_SIDE];
    let (mut sum, mut voters) = (0.0, 0);
    for (n, y) in rows.enumerate() {
        let start = columns.start.wrapping_add_signed(dx);
        let there = &there.row(y.wrapping_add_signed(dy))[start..start + columns.len()];
        let here = here.row(y)[columns.clone()].iter();
        let squares = here.zip(there).zip(&variance.row(y)[columns.clone()]);
        let squares: Vec<f32> = squares.map(|((a, b), v)| (a - b) * (a - b) / (4.0 * v)).collect();
        for (sum, squares) in sums.iter_mut().zip(squares.chunks_exact(VOTER_SIDE)) {
            *sum += squares.iter().sum::<f32>();
        }
        if n % VOTER_SIDE == VOTER_SIDE - 1 {
            let noise = 0.5 * (VOTER_SIDE * VOTER_SIDE) as f32;
            sum += sums.iter().map(|square| (square - noise).min(MAX_VOTE)).sum::<f32>();
            voters += sums.len();
            sums.fill(0.0);
        }
    }
    let all = (height / VOTER_SIDE) * (width / VOTER_SIDE);
    if 5 * voters < 2 * all { f32::INFINITY } else { sum / voters as f32 }
}

/// Moves every frame a little closer to the mean of the others (Baker and Matthews, "Lucas-Kanade 20 years
/// on", IJCV 56(3), 2004, with the mean of the other frames as template).
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

    /// Returns an aperiodic texture of mean 2.
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

    /// Uneven camera path: x and y in pixels, and zoom.
    const PATH: [[f32; 3]; 7] = [
        [-21.0, 4.0, 0.98],
        [-16.0, 1.5, 0.985],
        [-5.0, -0.5, 0.99],
        [0.0, 0.0, 1.0],
        [9.5, 0.5, 1.0],
        [14.0, 3.0, 1.01],
        [26.0, 3.5, 1.02],
    ];

    /// Simulates frames whose counts vary approximately as photons do. A dark square of a tenth of the image
    /// stays in place.
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
