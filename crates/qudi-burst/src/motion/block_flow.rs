//! Optical flow between two clean frames by block matching: for recorded clips, whose true motion
//! nobody knows. Coarse to fine over a pyramid; each block starts from the vectors around it one level
//! up and searches nearby; the finest level is refined to a fraction of a pixel by Gauss-Newton
//! steps (Lucas, Kanade 1981). Made for truth: noise would be matched as well.

use qudi_core::flow::Flow;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Pixels between block centres.
const STEP: usize = 8;

/// Half a block's side in pixels: blocks overlap by half.
const HALF: isize = 8;

/// Pixels searched around the best starting vector, per level.
const REACH: isize = 2;

/// Smallest side of the coarsest level in pixels: a block.
const COARSEST: usize = 16;

/// Refining steps; they converge in two or three.
const REFINEMENTS: usize = 4;

/// What a vector other than the one from above must gain, in mean squared difference: where nothing
/// can be seen, nothing moves on its own. One gray value of 255.
const GAIN: f32 = 1.0 / 255.0 / 255.0;

/// Two-way error allowed, as a share of both squared lengths and in square pixels (Sundaram et al. 2010).
const TWO_WAY: (f32, f32) = (0.01, 0.5);

/// The truth itself may change this much along its flow, in image units: beyond it the vector is wrong
/// or the surface hidden, and a blurred result would look better than the truth.
const PHOTOMETRIC: f32 = 0.1;

/// Displacement of every pixel of `now` in `next`; `visible` where the way back leads home, stays
/// inside the frame, and finds nearly the same value.
pub fn estimate_flow(now: &Frame, next: &Frame) -> Flow {
    let size = now.size;
    let (there, back) = rayon::join(|| dense(now, next), || dense(next, now));
    let visible = (0..size.pixels())
        .map(|i| {
            let [dx, dy] = there[i];
            let (x, y) = ((i % size.width) as f32 + dx, (i / size.width) as f32 + dy);
            let inside = x >= 0.0
                && y >= 0.0
                && x <= (size.width - 1) as f32
                && y <= (size.height - 1) as f32;
            if !inside {
                return false;
            }
            let [bx, by] = back[y.round() as usize * size.width + x.round() as usize];
            let (sum, lengths) =
                ((dx + bx).powi(2) + (dy + by).powi(2), dx * dx + dy * dy + bx * bx + by * by);
            let change = next.bilinear(f64::from(x), f64::from(y)) - now.data[i];
            sum <= TWO_WAY.0 * lengths + TWO_WAY.1 && change.abs() <= PHOTOMETRIC
        })
        .collect();
    let (dx, dy) = there.iter().map(|v| (v[0], v[1])).unzip();
    Flow { size, dx, dy, visible }
}

/// One vector (dx, dy) per pixel.
fn dense(now: &Frame, next: &Frame) -> Vec<[f32; 2]> {
    let mut levels = vec![(now.clone(), next.clone())];
    while levels[levels.len() - 1].0.size.height.min(levels[levels.len() - 1].0.size.width)
        >= 2 * COARSEST
    {
        let (now, next) = &levels[levels.len() - 1];
        let halves = (halved(now), halved(next));
        levels.push(halves);
    }
    let mut field = Field::still(levels[levels.len() - 1].0.size);
    for (level, (now, next)) in levels.iter().enumerate().rev() {
        if level + 1 < levels.len() {
            field = field.doubled(now.size);
        }
        field = field.matched(now, next);
    }
    field.refine(now, next);
    field.spread(now.size)
}

/// Half the size, means over 2 x 2 pixels; an odd last row or column is dropped.
fn halved(frame: &Frame) -> Frame {
    let size = Size { height: frame.size.height / 2, width: frame.size.width / 2 };
    let at = |x: usize, y: usize| frame.data[y * frame.size.width + x];
    Frame::from_fn(size, |x, y| {
        let (x, y) = (2 * x, 2 * y);
        0.25 * (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1))
    })
}

/// Vectors of the blocks, whose middles lie [`STEP`] pixels apart.
struct Field {
    rows: usize,
    columns: usize,
    vectors: Vec<[f32; 2]>,
}

impl Field {
    fn still(size: Size) -> Self {
        let (rows, columns) = (size.height.div_ceil(STEP), size.width.div_ceil(STEP));
        Self { rows, columns, vectors: vec![[0.0; 2]; rows * columns] }
    }

    /// The vector of a block; of the nearest one beyond the border.
    fn at(&self, row: isize, column: isize) -> [f32; 2] {
        let row = row.clamp(0, self.rows as isize - 1) as usize;
        let column = column.clamp(0, self.columns as isize - 1) as usize;
        self.vectors[row * self.columns + column]
    }

    /// The same motion on the next finer level, of `size`.
    fn doubled(&self, size: Size) -> Self {
        let mut finer = Self::still(size);
        for (i, vector) in finer.vectors.iter_mut().enumerate() {
            let [dx, dy] =
                self.at((i / finer.columns / 2) as isize, (i % finer.columns / 2) as isize);
            *vector = [2.0 * dx, 2.0 * dy];
        }
        finer
    }

    /// Of the vectors of each block and its four neighbours the best, and the best whole one near it.
    fn matched(&self, now: &Frame, next: &Frame) -> Self {
        let vectors = (0..self.vectors.len()).into_par_iter().map(|i| {
            let (row, column) = ((i / self.columns) as isize, (i % self.columns) as isize);
            let centre = centre(row as usize, column as usize);
            let cost = |vector| difference(now, next, centre, vector);
            let mut best = self.at(row, column);
            let mut least = cost(best) - GAIN;
            let mut try_out = |vector: [f32; 2]| {
                let cost = cost(vector);
                if cost < least {
                    (best, least) = (vector, cost);
                }
                best
            };
            let mut start = self.at(row, column);
            for (r, c) in [(-1, 0), (1, 0), (0, -1), (0, 1)] {
                start = try_out(self.at(row + r, column + c));
            }
            for dy in -REACH..=REACH {
                for dx in -REACH..=REACH {
                    try_out([start[0] + dx as f32, start[1] + dy as f32]);
                }
            }
            best
        });
        Self { vectors: vectors.collect(), ..*self }
    }

    /// Moves each vector by fractions of a pixel as long as that matches better.
    fn refine(&mut self, now: &Frame, next: &Frame) {
        let columns = self.columns;
        self.vectors.par_iter_mut().enumerate().for_each(|(i, vector)| {
            let centre = centre(i / columns, i % columns);
            let mut least = difference(now, next, centre, *vector);
            for _ in 0..REFINEMENTS {
                let Some([dx, dy]) = step(now, next, centre, *vector) else { return };
                let moved = [vector[0] + dx, vector[1] + dy];
                let cost = difference(now, next, centre, moved);
                if cost >= least {
                    return;
                }
                (*vector, least) = (moved, cost);
            }
        });
    }

    /// Between blocks, in a straight line.
    fn spread(&self, size: Size) -> Vec<[f32; 2]> {
        let place = |at: usize| {
            let place = (at as f32 + 0.5) / STEP as f32 - 0.5;
            (place.floor() as isize, place - place.floor())
        };
        (0..size.pixels())
            .map(|i| {
                let ((row, down), (column, across)) =
                    (place(i / size.width), place(i % size.width));
                let mix = |k: usize| {
                    let line = |row| {
                        let (left, right) = (self.at(row, column)[k], self.at(row, column + 1)[k]);
                        left + across * (right - left)
                    };
                    let (upper, lower) = (line(row), line(row + 1));
                    upper + down * (lower - upper)
                };
                [mix(0), mix(1)]
            })
            .collect()
    }
}

/// The middle of a block in pixels (x, y).
fn centre(row: usize, column: usize) -> [isize; 2] {
    [(column * STEP + STEP / 2) as isize, (row * STEP + STEP / 2) as isize]
}

/// Pixels (x, y) of a block that lie inside the frame.
fn block(size: Size, centre: [isize; 2]) -> impl Iterator<Item = (usize, usize)> {
    let span = |at: isize, end: usize| {
        (at - HALF).max(0) as usize..(at + HALF).clamp(0, end as isize) as usize
    };
    let (xs, ys) = (span(centre[0], size.width), span(centre[1], size.height));
    ys.flat_map(move |y| xs.clone().map(move |x| (x, y)))
}

/// Mean squared difference of a block of `now` and of `next` displaced by `vector`.
fn difference(now: &Frame, next: &Frame, centre: [isize; 2], vector: [f32; 2]) -> f32 {
    let width = now.size.width;
    let (mut total, mut n) = (0.0, 0u32);
    let whole = vector[0].fract() == 0.0 && vector[1].fract() == 0.0;
    let (right, bottom) = (next.size.width as isize - 1, next.size.height as isize - 1);
    for (x, y) in block(now.size, centre) {
        let there = if whole {
            let x = (x as isize + vector[0] as isize).clamp(0, right);
            let y = (y as isize + vector[1] as isize).clamp(0, bottom);
            next.data[y as usize * width + x as usize]
        } else {
            next.bilinear(x as f64 + f64::from(vector[0]), y as f64 + f64::from(vector[1]))
        };
        total += (there - now.data[y * width + x]).powi(2);
        n += 1;
    }
    total / n.max(1) as f32
}

/// One Gauss-Newton step; none where the block has too little texture to tell both directions.
fn step(now: &Frame, next: &Frame, centre: [isize; 2], vector: [f32; 2]) -> Option<[f32; 2]> {
    let (mut xx, mut xy, mut yy, mut xt, mut yt) = (0.0f64, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in block(now.size, centre) {
        let value = now.data[y * now.size.width + x];
        let (x, y) = (x as f64 + f64::from(vector[0]), y as f64 + f64::from(vector[1]));
        let there = |dx: f64, dy: f64| f64::from(next.bilinear(x + dx, y + dy));
        let (gx, gy) = (
            0.5 * (there(1.0, 0.0) - there(-1.0, 0.0)),
            0.5 * (there(0.0, 1.0) - there(0.0, -1.0)),
        );
        let change = there(0.0, 0.0) - f64::from(value);
        xx += gx * gx;
        xy += gx * gy;
        yy += gy * gy;
        xt += gx * change;
        yt += gy * change;
    }
    let determinant = xx * yy - xy * xy;
    // Nearly parallel gradients: the step along the edge would be noise.
    if determinant <= 1e-3 * (xx + yy).powi(2) || determinant <= 0.0 {
        return None;
    }
    let (dx, dy) = ((xy * yt - yy * xt) / determinant, (xy * xt - xx * yt) / determinant);
    (dx.abs() <= 1.0 && dy.abs() <= 1.0).then_some([dx as f32, dy as f32])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::warping_error;
    use qudi_sim::scene::{PROCEDURAL, Procedural};

    /// A texture of several scales, displaced by (`dx`, `dy`).
    fn texture(size: Size, dx: f64, dy: f64) -> Frame {
        Frame::from_fn(size, |x, y| {
            let (x, y) = (x as f64 - dx, y as f64 - dy);
            let waves = (0.31 * x + 0.12 * y).sin()
                + (0.27 * y - 0.07 * x).sin()
                + (0.043 * x + 0.031 * y).sin()
                + (0.05 * y - 0.021 * x + 1.0).sin();
            (0.5 + 0.11 * waves) as f32
        })
    }

    #[test]
    fn known_translations_are_found_to_a_twentieth_of_a_pixel() {
        let size = Size { height: 120, width: 150 };
        let now = texture(size, 0.0, 0.0);
        for [dx, dy] in [[0.0, 0.0], [3.0, -2.0], [0.4, 0.7], [-5.3, 6.6], [10.2, 8.7]] {
            let flow = estimate_flow(&now, &texture(size, dx, dy));
            let inner: Vec<usize> = (0..size.pixels())
                .filter(|i| (24..96).contains(&(i / 150)) && (24..126).contains(&(i % 150)))
                .collect();
            let mut errors: Vec<f64> = inner
                .iter()
                .map(|&i| (f64::from(flow.dx[i]) - dx).hypot(f64::from(flow.dy[i]) - dy))
                .collect();
            errors.sort_by(f64::total_cmp);
            let seen = inner.iter().filter(|&&i| flow.visible[i]).count();
            assert!(errors[errors.len() / 2] < 0.05, "{dx} {dy}: {}", errors[errors.len() / 2]);
            assert!(errors[errors.len() * 95 / 100] < 0.3, "{dx} {dy}");
            assert!(seen * 100 > inner.len() * 95, "{dx} {dy}: {seen} of {}", inner.len());
        }
    }

    #[test]
    fn flow_is_zero_without_texture_and_small_frames_do_not_panic() {
        for (height, width) in [(1, 1), (3, 40), (64, 64), (65, 33)] {
            let flat = Frame::filled(Size { height, width }, 0.4);
            let flow = estimate_flow(&flat, &flat);
            assert!(flow.dx.iter().chain(&flow.dy).all(|&v| v == 0.0));
            assert!(flow.visible.iter().all(|&v| v));
        }
    }

    #[test]
    fn flicker_skips_occluded_and_leaving_pixels() {
        let size = Size { height: 96, width: 128 };
        let now = texture(size, 0.0, 0.0);
        let mut next = now.clone();
        // A black square appears in front.
        for y in 30..60 {
            next.data[y * 128 + 50..y * 128 + 80].fill(0.0);
        }
        let flow = estimate_flow(&now, &next);
        let seen = |ys: std::ops::Range<usize>, xs: std::ops::Range<usize>| {
            let all = ys.len() * xs.len();
            let seen: usize =
                ys.map(|y| xs.clone().filter(|x| flow.visible[y * 128 + x]).count()).sum();
            seen as f64 / all as f64
        };
        assert!(seen(32..58, 52..78) < 0.1, "{}", seen(32..58, 52..78));
        assert!(seen(70..96, 0..128) > 0.95);
        let gone = estimate_flow(&now, &texture(size, 9.0, 0.0));
        assert!((0..96).all(|y| !gone.visible[y * 128 + 127]), "left through the right border");
    }

    /// On scenes whose flow is known, the truth changes along the estimated flow about as little as
    /// along the true one.
    #[test]
    fn truth_hardly_changes_along_its_flow() {
        let size = Size { height: 128, width: 160 };
        for &kind in PROCEDURAL {
            let scene = Procedural { kind, size, seed: 3, speed: 3.0 }.scene();
            let (now, next) = (scene.render(0.0), scene.render(1.0));
            let still = Flow {
                size,
                dx: vec![0.0; size.pixels()],
                dy: vec![0.0; size.pixels()],
                visible: vec![true; size.pixels()],
            };
            let flow = estimate_flow(&now, &next);
            let found = warping_error(&now, &next, &flow).unwrap();
            let unmoved = warping_error(&now, &next, &still).unwrap();
            let seen = flow.visible.iter().filter(|&&v| v).count() as f64 / size.pixels() as f64;
            assert!(found < 0.1 * unmoved, "{kind:?}: {found} {unmoved}");
            assert!(seen > 0.35, "{kind:?}: {seen}");
        }
    }
}
