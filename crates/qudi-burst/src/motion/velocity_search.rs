//! Search for the constant velocity that best explains the counts of all frames.
//!
//! Two frames of a few photons tell little about the motion of a faint texture. Along the right path,
//! however, all frames of a window show the same content and differ by noise alone. Every patch takes the
//! velocity of a lattice along which the frames vary least. Neighbours support each other by semi-global
//! matching (Hirschmüller, "Stereo processing by semiglobal matching and mutual information", IEEE TPAMI
//! 30(2), 2008, eq. 13), with velocities in place of disparities. The search is exhaustive and needs no
//! start, unlike a search from coarse to fine.

use super::grid::Grid;
use super::pyramid::shrink;
use qudi_core::sensor::CountMoments;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Factor by which frames are shrunk for the search.
const SHRINK_FACTOR: usize = 4;

/// Step of the velocity lattice, in shrunk pixels per frame.
const VELOCITY_STEP: f32 = 0.1;
/// Largest velocity along an axis, in steps of the lattice.
const MAX_STEPS: usize = 20;
/// Number of velocities along an axis.
const VELOCITIES_PER_AXIS: usize = 2 * MAX_STEPS + 1;
/// Number of velocities of the lattice.
const VELOCITIES: usize = VELOCITIES_PER_AXIS * VELOCITIES_PER_AXIS;

/// Label of zero velocity.
const REST_LABEL: usize = MAX_STEPS * VELOCITIES_PER_AXIS + MAX_STEPS;

/// Radius of the square around a patch's centre that is compared, in shrunk pixels.
const RADIUS: usize = 2;

/// Nats per unit of the square's mean excess variance: half the number of pixels that are independent after
/// smoothing.
const NATS_PER_EXCESS: f32 = 1.0 / 3.0;

/// Penalty in nats of the adjacent velocity between neighbouring patches (`P1` in the paper).
const ADJACENT_PENALTY: f32 = 1.0;
/// Penalty in nats of any other velocity between neighbouring patches (`P2` in the paper).
const JUMP_PENALTY: f32 = 6.0;

/// Fraction of the variance of white noise that remains after the filter 1 2 1 along an axis.
const REMAINING_VARIANCE: f32 = 0.375;
/// Correlation of neighbouring pixels after the filter.
const CORRELATION: f32 = 2.0 / 3.0;

/// Shrunk frames, small enough to try every velocity.
#[derive(Debug)]
pub(crate) struct VelocitySearch {
    frames: Vec<Frame>,
    /// Noise variance of each pixel.
    variance: Vec<f32>,
    size: Size,
}

impl VelocitySearch {
    /// Prepares the search on the counts of a window.
    pub(crate) fn new(frames: &[Frame], moments: &CountMoments) -> Self {
        let size = frames[0].size;
        let size = Size { height: size.height / SHRINK_FACTOR, width: size.width / SHRINK_FACTOR };
        let frames: Vec<Frame> =
            frames.par_iter().map(|frame| smoothed(&shrink(frame, size, SHRINK_FACTOR))).collect();
        let share = 1.0 / frames.len() as f32;
        let variance = |p: usize| {
            let mean = share * frames.iter().map(|frame| frame.data[p]).sum::<f32>();
            let variance = moments.variance_at_mean(f64::from(mean)) as f32;
            variance.max(1e-4) * REMAINING_VARIANCE * REMAINING_VARIANCE
                / (SHRINK_FACTOR * SHRINK_FACTOR) as f32
        };
        let variance = (0..size.pixels()).map(variance).collect();
        Self { frames, variance, size }
    }

    /// Finds the velocity of every patch of frame `reference`, in pixels of the frames per frame, right and
    /// down. A patch is static or moves with the whole frame unless another velocity fits better by
    /// `evidence` nats.
    pub(crate) fn velocities(&self, grid: &Grid, reference: usize, evidence: f32) -> Vec<[f32; 2]> {
        let places: Vec<[usize; 2]> = (0..grid.len())
            .map(|i| grid.corner(i).map(|corner| (corner + grid.side / 2) / SHRINK_FACTOR))
            .collect();
        let columns: Vec<Vec<f32>> = (0..VELOCITIES)
            .into_par_iter()
            .map(|label| {
                let excess = self.excess(reference, velocity(label));
                places.iter().map(|&place| NATS_PER_EXCESS * self.around(place, &excess)).collect()
            })
            .collect();
        let cost: Vec<Vec<f32>> = (0..places.len())
            .map(|i| columns.iter().map(|column: &Vec<f32>| column[i]).collect())
            .collect();
        let total = matched(&cost, grid.xs.len());
        let priors = if evidence > 0.0 { vec![REST_LABEL, common(&columns)] } else { Vec::new() };
        let velocity = |total: &Vec<f32>| {
            let best = lowest_label(total);
            let as_good = |&&prior: &&usize| total[prior] - total[best] < evidence;
            let label = priors.iter().find(as_good).copied().unwrap_or(best);
            lowest_around(total, label)
        };
        total.iter().map(|total| velocity(total).map(|v| v * SHRINK_FACTOR as f32)).collect()
    }

    /// Computes the excess variance of the frames along a velocity at every pixel, in units of the noise's
    /// variance.
    fn excess(&self, reference: usize, velocity: [f32; 2]) -> Vec<f32> {
        let Size { height, width } = self.size;
        let pixels = self.size.pixels();
        let [mut sum, mut squares, mut count, mut noise] = [(); 4].map(|()| vec![0.0f32; pixels]);
        for (k, frame) in self.frames.iter().enumerate() {
            let d = velocity.map(|v| v * (k as f32 - reference as f32));
            let shift = Shift::new(d);
            let (columns, rows) = (shift.range(0, width), shift.range(1, height));
            let length = columns.len();
            // Without overlap there are no positions.
            for y in rows.filter(|_| length > 0) {
                let [upper, lower] = [0, 1].map(|below| {
                    let row = frame.row((y as isize + shift.whole[1]) as usize + below);
                    let start = (columns.start as isize + shift.whole[0]) as usize;
                    &row[start..=start + length]
                });
                let place = y * width + columns.start..y * width + columns.end;
                let sums = sum[place.clone()].iter_mut().zip(&mut squares[place.clone()]);
                let counts = count[place.clone()].iter_mut().zip(&mut noise[place]);
                let upper = upper.iter().zip(&upper[1..]);
                let lower = lower.iter().zip(&lower[1..]);
                for (((a, b), (c, d)), ((sum, squares), (count, noise))) in
                    upper.zip(lower).zip(sums.zip(counts))
                {
                    let value = shift.between([*a, *b, *c, *d]);
                    *sum += value;
                    *squares += value * value;
                    *count += 1.0;
                    *noise += shift.noise;
                }
            }
        }
        (0..pixels)
            .map(|p| over_noise(sum[p], squares[p], count[p], noise[p], self.variance[p]))
            .collect()
    }

    /// Returns the mean of `plane` over the square around a position.
    fn around(&self, [x, y]: [usize; 2], plane: &[f32]) -> f32 {
        let near =
            |at: usize, length: usize| at.saturating_sub(RADIUS)..(at + RADIUS + 1).min(length);
        let (columns, rows) = (near(x, self.size.width), near(y, self.size.height));
        let count = (columns.len() * rows.len()) as f32;
        let row = |y: usize| plane[y * self.size.width..][columns.clone()].iter().sum::<f32>();
        rows.map(row).sum::<f32>() / count
    }
}

/// Returns the excess over noise of the squared deviations of `count` values from their mean. It is 0 for one
/// value.
fn over_noise(sum: f32, squares: f32, count: f32, noise: f32, variance: f32) -> f32 {
    if count < 2.0 {
        return 0.0;
    }
    (squares - sum * sum / count) / variance - noise * (1.0 - 1.0 / count)
}

/// Returns the velocity of a label, in shrunk pixels per frame.
fn velocity(label: usize) -> [f32; 2] {
    [label % VELOCITIES_PER_AXIS, label / VELOCITIES_PER_AXIS]
        .map(|k| (k as f32 - MAX_STEPS as f32) * VELOCITY_STEP)
}

/// A displacement with subpixel precision.
struct Shift {
    whole: [isize; 2],
    weights: [f32; 4],
    /// Factor by which interpolation reduces the noise's variance.
    noise: f32,
}

impl Shift {
    fn new(d: [f32; 2]) -> Self {
        let whole = d.map(f32::floor);
        let [x, y] = [d[0] - whole[0], d[1] - whole[1]];
        let left = |part: f32| 1.0 - 2.0 * part * (1.0 - part) * (1.0 - CORRELATION);
        Self {
            whole: whole.map(|d| d as isize),
            weights: [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y],
            noise: left(x) * left(y),
        }
    }

    /// Returns the positions along an axis whose displaced positions lie inside the image.
    fn range(&self, axis: usize, length: usize) -> std::ops::Range<usize> {
        let (whole, length) = (self.whole[axis], length as isize);
        let start = (-whole).clamp(0, length);
        let end = (length - 1 - whole).clamp(start, length);
        start as usize..end as usize
    }

    fn between(&self, corners: [f32; 4]) -> f32 {
        let [a, b, c, d] = self.weights;
        corners[0] * a + corners[1] * b + corners[2] * c + corners[3] * d
    }
}

/// Aggregates the cost of every velocity for every patch, `[patch][label]`, over paths from the left, right,
/// top and bottom.
fn matched(cost: &[Vec<f32>], columns: usize) -> Vec<Vec<f32>> {
    let rows = cost.len() / columns;
    let across = |y: usize| (0..columns).map(move |x| y * columns + x).collect::<Vec<_>>();
    let down = |x: usize| (0..rows).map(move |y| y * columns + x).collect::<Vec<_>>();
    let mut lines: Vec<Vec<usize>> = (0..rows).map(across).chain((0..columns).map(down)).collect();
    let back: Vec<_> = lines.iter().map(|line| line.iter().rev().copied().collect()).collect();
    lines.extend(back);
    let mut total: Vec<Vec<f32>> =
        cost.iter().map(|own| own.iter().map(|c| -3.0 * c).collect()).collect();
    for group in lines.chunks(rows + columns) {
        let summed: Vec<_> = group.par_iter().map(|line| along(cost, line)).collect();
        for (line, summed) in group.iter().zip(summed) {
            for (&i, summed) in line.iter().zip(summed) {
                for (total, summed) in total[i].iter_mut().zip(summed) {
                    *total += summed;
                }
            }
        }
    }
    total
}

/// Aggregates the costs of the patches along a line (Hirschmüller 2008, eq. 13).
fn along(cost: &[Vec<f32>], line: &[usize]) -> Vec<Vec<f32>> {
    let mut summed: Vec<Vec<f32>> = Vec::with_capacity(line.len());
    for &i in line {
        let Some(last) = summed.last() else {
            summed.push(cost[i].clone());
            continue;
        };
        let least = last.iter().copied().fold(f32::INFINITY, f32::min);
        let from = |label: usize| {
            let (x, y) = (label % VELOCITIES_PER_AXIS, label / VELOCITIES_PER_AXIS);
            let mut best = last[label].min(least + JUMP_PENALTY);
            if x > 0 {
                best = best.min(last[label - 1] + ADJACENT_PENALTY);
            }
            if x + 1 < VELOCITIES_PER_AXIS {
                best = best.min(last[label + 1] + ADJACENT_PENALTY);
            }
            if y > 0 {
                best = best.min(last[label - VELOCITIES_PER_AXIS] + ADJACENT_PENALTY);
            }
            if y + 1 < VELOCITIES_PER_AXIS {
                best = best.min(last[label + VELOCITIES_PER_AXIS] + ADJACENT_PENALTY);
            }
            best - least
        };
        let next = cost[i].iter().enumerate().map(|(label, cost)| cost + from(label)).collect();
        summed.push(next);
    }
    summed
}

/// Returns the label of the velocity with the least total cost over all patches.
fn common(columns: &[Vec<f32>]) -> usize {
    let cost = |label: usize| columns[label].iter().map(|&cost| f64::from(cost)).sum::<f64>();
    let costs: Vec<f64> = (0..VELOCITIES).map(cost).collect();
    (0..VELOCITIES).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(REST_LABEL)
}

/// Returns the label of the velocity of least cost.
fn lowest_label(total: &[f32]) -> usize {
    (0..VELOCITIES).min_by(|&a, &b| total[a].total_cmp(&total[b])).unwrap_or(0)
}

/// Refines the velocity of label `best` between lattice points by fitting parabolas.
fn lowest_around(total: &[f32], best: usize) -> [f32; 2] {
    let at = velocity(best);
    let offset = |k: usize, step: usize| {
        if k == 0 || k + 1 == VELOCITIES_PER_AXIS {
            return 0.0;
        }
        lowest_between([total[best - step], total[best], total[best + step]])
    };
    [
        at[0] + VELOCITY_STEP * offset(best % VELOCITIES_PER_AXIS, 1),
        at[1] + VELOCITY_STEP * offset(best / VELOCITIES_PER_AXIS, VELOCITIES_PER_AXIS),
    ]
}

/// Returns the minimum of the parabola through three costs, in steps from the middle one, clamped to half a
/// step.
pub(crate) fn lowest_between([below, least, above]: [f32; 3]) -> f32 {
    let bend = below - 2.0 * least + above;
    let part = 0.5 * (below - above) / bend;
    // Costs may be infinite.
    if bend > 0.0 && part.is_finite() { part.clamp(-0.5, 0.5) } else { 0.0 }
}

/// Applies the filter 1 2 1 along both axes, with borders repeated. It makes the noise depend less on
/// subpixel shifts.
fn smoothed(image: &Frame) -> Frame {
    let Size { height, width } = image.size;
    let rows = Frame::from_fn(image.size, |x, y| {
        let row = image.row(y);
        0.25 * (row[x.saturating_sub(1)] + row[(x + 1).min(width - 1)]) + 0.5 * row[x]
    });
    Frame::from_fn(image.size, |x, y| {
        let [above, below] = [y.saturating_sub(1), (y + 1).min(height - 1)].map(|y| rows.row(y)[x]);
        0.25 * (above + below) + 0.5 * rows.row(y)[x]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::{CountLaw, Sensor};
    use qudi_core::{Camera, Light};

    /// Checks that the velocity of a texture too faint for two frames is found for nearly every patch.
    #[test]
    fn finds_faint_constant_motion() {
        let size = Size { height: 96, width: 112 };
        let velocity = [1.7, -0.9];
        let texture = |x: f32, y: f32| {
            let wave = (0.31 * x + 0.12 * y).sin() + (0.23 * y - 0.17 * x + 1.0).sin();
            0.45 + 0.04 * wave + 0.03 * (0.41 * (x - y)).cos()
        };
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let light = Light { ppp: 3.25, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, size, light, 5).unwrap_or_else(|e| panic!("{e}"));
        let frames: Vec<Frame> = (0..11u8)
            .map(|k| {
                let t = f32::from(k);
                let scene = Frame::from_fn(size, |x, y| {
                    texture(x as f32 - t * velocity[0], y as f32 - t * velocity[1])
                });
                let counts =
                    camera.expose(u64::from(k), &[&scene]).unwrap_or_else(|e| panic!("{e}"));
                Frame { size, data: counts.into_iter().map(f32::from).collect() }
            })
            .collect();
        let moments = CountMoments::new(&CountLaw::new(&sensor, camera.gain()));
        let grid = Grid::new(size, 16, 8);
        let found = VelocitySearch::new(&frames, &moments).velocities(&grid, 5, 0.0);
        let error = |v: &[f32; 2]| (v[0] - velocity[0]).hypot(v[1] - velocity[1]);
        let mut errors: Vec<f32> = found.iter().map(error).collect();
        errors.sort_unstable_by(f32::total_cmp);
        let (median, most) = (errors[errors.len() / 2], errors[errors.len() * 9 / 10]);
        assert!(median < 0.15 && most < 0.4, "{median} {most}");
    }

    #[test]
    fn parabolas_have_their_lowest_point_between_velocities() {
        let at = [0.43, -1.27];
        let cost = |label| {
            let [x, y] = velocity(label);
            (x - at[0]).powi(2) + (y - at[1]).powi(2)
        };
        let costs: Vec<f32> = (0..VELOCITIES).map(cost).collect();
        let found = lowest_around(&costs, lowest_label(&costs));
        assert!((found[0] - at[0]).abs() < 1e-3 && (found[1] - at[1]).abs() < 1e-3, "{found:?}");
    }

    /// Checks that a patch without evidence follows its neighbours, and a patch with evidence does not.
    #[test]
    fn neighbouring_hypotheses_help_but_do_not_overrule() {
        let certain =
            |label: usize| (0..VELOCITIES).map(|l| if l == label { 0.0 } else { 40.0 }).collect();
        let (one, other) = (100, 900);
        let cost = vec![certain(one), vec![0.0; VELOCITIES], certain(one), certain(other)];
        let total = matched(&cost, 4);
        let best = |i: usize| {
            (0..VELOCITIES).min_by(|&a, &b| total[i][a].total_cmp(&total[i][b])).unwrap_or(0)
        };
        assert_eq!([best(0), best(1), best(2), best(3)], [one, one, one, other]);
    }
}
