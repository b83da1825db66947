//! Search for the constant velocity that the counts of all frames agree on.
//!
//! Two frames of a few photons say little of how a faint texture moves from one to the other. Along the right
//! path, though, all frames of a window show the same, and differ by noise alone. Of all velocities on a
//! lattice every patch takes the one along which the frames vary least, and neighbours help each other:
//! semi-global matching (Hirschmüller, "Stereo processing by semiglobal matching and mutual information",
//! IEEE TPAMI 30(2), 2008, eq. 13) with velocities for disparities. What is found is exhaustive and knows no
//! start, unlike a search from coarse to fine.

use super::grid::Grid;
use super::pyramid::shrink;
use qudi_core::sensor::CountMoments;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Pixels of the frames along a side of a pixel here.
const SHRINK: usize = 4;

/// From one velocity of the lattice to the next, in pixels here per frame, and the fastest in these steps.
const STEP: f32 = 0.1;
const FASTEST: usize = 20;
const ACROSS: usize = 2 * FASTEST + 1;
const VELOCITIES: usize = ACROSS * ACROSS;

/// The label of no motion.
const REST: usize = FASTEST * ACROSS + FASTEST;

/// Pixels here around a patch's centre, to either side, that decide for it.
const RADIUS: usize = 2;

/// Nats of a mean excess of one variance over those pixels: half of them for each that noise leaves
/// independent.
const NATS: f32 = 1.0 / 3.0;

/// Price in nats of the next velocity of the lattice, and of any other, from one patch to its neighbour (`P1`
/// and `P2` there).
const NEXT: f32 = 1.0;
const ANY: f32 = 6.0;

/// Variance that the filter 1 2 1 leaves of white noise along a side, and the correlation of neighbours after
/// it.
const LEFT: f32 = 0.375;
const CORRELATION: f32 = 2.0 / 3.0;

/// Frames small enough to try every velocity.
#[derive(Debug)]
pub(crate) struct VelocitySearch {
    frames: Vec<Frame>,
    /// Of the noise of each pixel.
    variance: Vec<f32>,
    size: Size,
}

impl VelocitySearch {
    /// Of the counts of a window.
    pub(crate) fn new(frames: &[Frame], moments: &CountMoments) -> Self {
        let size = frames[0].size;
        let size = Size { height: size.height / SHRINK, width: size.width / SHRINK };
        let frames: Vec<Frame> =
            frames.par_iter().map(|frame| smoothed(&shrink(frame, size, SHRINK))).collect();
        let share = 1.0 / frames.len() as f32;
        let variance = |p: usize| {
            let mean = share * frames.iter().map(|frame| frame.data[p]).sum::<f32>();
            let variance = moments.variance_at_mean(f64::from(mean)) as f32;
            variance.max(1e-4) * LEFT * LEFT / (SHRINK * SHRINK) as f32
        };
        let variance = (0..size.pixels()).map(variance).collect();
        Self { frames, variance, size }
    }

    /// The velocity of every patch of frame `reference`, in the pixels of the frames per frame, right and
    /// down. It is rest, or that of the whole frame, unless another fits better by `evidence` nats.
    pub(crate) fn velocities(&self, grid: &Grid, reference: usize, evidence: f32) -> Vec<[f32; 2]> {
        let places: Vec<[usize; 2]> = (0..grid.len())
            .map(|i| grid.corner(i).map(|corner| (corner + grid.side / 2) / SHRINK))
            .collect();
        let columns: Vec<Vec<f32>> = (0..VELOCITIES)
            .into_par_iter()
            .map(|label| {
                let excess = self.excess(reference, velocity(label));
                places.iter().map(|&place| NATS * self.around(place, &excess)).collect()
            })
            .collect();
        let cost: Vec<Vec<f32>> = (0..places.len())
            .map(|i| columns.iter().map(|column: &Vec<f32>| column[i]).collect())
            .collect();
        let total = matched(&cost, grid.xs.len());
        let priors = if evidence > 0.0 { vec![REST, common(&columns)] } else { Vec::new() };
        let velocity = |total: &Vec<f32>| {
            let best = lowest_label(total);
            let as_good = |&&prior: &&usize| total[prior] - total[best] < evidence;
            let label = priors.iter().find(as_good).copied().unwrap_or(best);
            lowest_around(total, label)
        };
        total.iter().map(|total| velocity(total).map(|v| v * SHRINK as f32)).collect()
    }

    /// By how much the frames vary along a velocity more than noise does, in its variance, at every pixel.
    fn excess(&self, reference: usize, velocity: [f32; 2]) -> Vec<f32> {
        let Size { height, width } = self.size;
        let pixels = self.size.pixels();
        let [mut sum, mut squares, mut count, mut noise] = [(); 4].map(|()| vec![0.0f32; pixels]);
        for (k, frame) in self.frames.iter().enumerate() {
            let d = velocity.map(|v| v * (k as f32 - reference as f32));
            let shift = Shift::new(d);
            let (columns, rows) = (shift.range(0, width), shift.range(1, height));
            let length = columns.len();
            // Where nothing is left, places do not exist.
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

    /// Mean of `plane` around a place.
    fn around(&self, [x, y]: [usize; 2], plane: &[f32]) -> f32 {
        let near =
            |at: usize, length: usize| at.saturating_sub(RADIUS)..(at + RADIUS + 1).min(length);
        let (columns, rows) = (near(x, self.size.width), near(y, self.size.height));
        let count = (columns.len() * rows.len()) as f32;
        let row = |y: usize| plane[y * self.size.width..][columns.clone()].iter().sum::<f32>();
        rows.map(row).sum::<f32>() / count
    }
}

/// Squared deviations from the mean of `count` values, over what noise makes of them. One value says nothing.
fn over_noise(sum: f32, squares: f32, count: f32, noise: f32, variance: f32) -> f32 {
    if count < 2.0 {
        return 0.0;
    }
    (squares - sum * sum / count) / variance - noise * (1.0 - 1.0 / count)
}

/// Velocity of a label, in pixels here per frame.
fn velocity(label: usize) -> [f32; 2] {
    [label % ACROSS, label / ACROSS].map(|k| (k as f32 - FASTEST as f32) * STEP)
}

/// A displacement between pixels.
struct Shift {
    whole: [isize; 2],
    weights: [f32; 4],
    /// Variance left of the noise of the pixels between which one samples.
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

    /// Places along an axis that stay inside.
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

/// What every velocity costs every patch, `[patch][label]`, when neighbours have their say, from left, right,
/// above and below.
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

/// The costs of a line's patches, with the best that their predecessors allow (Hirschmüller 2008, eq. 13).
fn along(cost: &[Vec<f32>], line: &[usize]) -> Vec<Vec<f32>> {
    let mut summed: Vec<Vec<f32>> = Vec::with_capacity(line.len());
    for &i in line {
        let Some(last) = summed.last() else {
            summed.push(cost[i].clone());
            continue;
        };
        let least = last.iter().copied().fold(f32::INFINITY, f32::min);
        let from = |label: usize| {
            let (x, y) = (label % ACROSS, label / ACROSS);
            let mut best = last[label].min(least + ANY);
            if x > 0 {
                best = best.min(last[label - 1] + NEXT);
            }
            if x + 1 < ACROSS {
                best = best.min(last[label + 1] + NEXT);
            }
            if y > 0 {
                best = best.min(last[label - ACROSS] + NEXT);
            }
            if y + 1 < ACROSS {
                best = best.min(last[label + ACROSS] + NEXT);
            }
            best - least
        };
        let next = cost[i].iter().enumerate().map(|(label, cost)| cost + from(label)).collect();
        summed.push(next);
    }
    summed
}

/// The label of the velocity that costs all patches together the least.
fn common(columns: &[Vec<f32>]) -> usize {
    let cost = |label: usize| columns[label].iter().map(|&cost| f64::from(cost)).sum::<f64>();
    let costs: Vec<f64> = (0..VELOCITIES).map(cost).collect();
    (0..VELOCITIES).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(REST)
}

/// The label of the velocity of least cost.
fn lowest_label(total: &[f32]) -> usize {
    (0..VELOCITIES).min_by(|&a, &b| total[a].total_cmp(&total[b])).unwrap_or(0)
}

/// The velocity of label `best`, between the lattice's by parabolas.
fn lowest_around(total: &[f32], best: usize) -> [f32; 2] {
    let at = velocity(best);
    let offset = |k: usize, step: usize| {
        if k == 0 || k + 1 == ACROSS {
            return 0.0;
        }
        lowest_between([total[best - step], total[best], total[best + step]])
    };
    [at[0] + STEP * offset(best % ACROSS, 1), at[1] + STEP * offset(best / ACROSS, ACROSS)]
}

/// Where the parabola through the least of costs and its neighbours is lowest, in steps from it.
pub(crate) fn lowest_between([below, least, above]: [f32; 3]) -> f32 {
    let bend = below - 2.0 * least + above;
    let part = 0.5 * (below - above) / bend;
    // Costs may be infinite.
    if bend > 0.0 && part.is_finite() { part.clamp(-0.5, 0.5) } else { 0.0 }
}

/// The filter 1 2 1 both ways, borders repeated: shifts between pixels then change noise less.
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

    /// A texture too faint for two frames, moving evenly: the true velocity is that of nearly every patch.
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

    /// What one patch does not know its neighbours tell; what it knows better it keeps.
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
