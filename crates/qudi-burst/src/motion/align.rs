//! Where each patch of a reference lies in another block of frames (Ma et al. 2020, section 5.1).
//!
//! From coarse to fine, every patch starts at the best of what its parent, the parent's neighbours and
//! the median of all found, and searches around it; at the finest level, steps of Lucas and Kanade (1981)
//! refine it below a pixel.

use super::grid::Grid;
use super::pyramid::{Level, Pyramid};
use crate::merge::dft::SIDE;
use qudi_core::Frame;

/// Cost of a search's step per squared pixel, in nats, at each level: where there is little to see, a
/// patch moves as its parent does. The coarsest knows no parent, and may go far.
const RELUCTANCE: [f32; 3] = [0.5, 0.5, 0.1];

/// Search radius at each level, finest first, in its pixels.
const RADII: [isize; 3] = [1, 4, 8];

/// Refining steps, as in the authors' experiments.
const STEPS: usize = 3;

/// Deviation in pixels of the refinement, if nothing is seen.
const STEP_PRIOR: f32 = 0.5;

/// Deviation in pixels of a patch's motion from that of its surroundings, if nothing is seen.
const NEIGHBOURS: f32 = 0.25;

/// Rounds of settling: each hands motion on by one patch.
const ROUNDS: usize = 4;

/// How far refining may move a patch in all, in pixels.
const REFINED: f32 = 1.0;

/// Patches of the finest level: half of each overlaps the next.
pub(crate) fn finest_grid(size: qudi_core::Size) -> Grid {
    Grid::new(size, SIDE, SIDE / 2)
}

/// The displacement of every patch of `reference` in `other`, in pixels, right and down. `variance` is
/// that of the noise of any two pixels' difference.
pub(crate) fn align(reference: &Pyramid, other: &Pyramid, variance: f32) -> Vec<[f32; 2]> {
    let mut parents: Option<(Grid, Vec<[isize; 2]>)> = None;
    for (number, (level, there)) in reference.levels.iter().zip(&other.levels).enumerate().rev() {
        let side = level.side;
        let step = if number == 0 { side / 2 } else { side };
        let ratio = reference.levels.get(number + 1).map_or(1, |coarser: &Level| coarser.ratio);
        let grid = Grid::new(level.image.size, side, step);
        let scale: usize = reference.levels[..=number].iter().map(|level| level.ratio).product();
        let noise = variance / (scale * scale) as f32;
        let matching = Matching {
            image: &level.image,
            there: &there.image,
            side,
            radius: RADII[number],
            // Squared differences count in nats: over twice the variance.
            reluctance: RELUCTANCE[number] * 2.0 * noise,
        };
        // The camera's own motion: for patches whose parent saw too little of it.
        let overall = parents.as_ref().map_or([0; 2], |(_, flow)| median(flow));
        let search = |i: usize| {
            let corner = grid.corner(i);
            let Some((coarse, flow)) = &parents else { return matching.best(corner, &[[0; 2]]) };
            let centre = corner.map(|c| (c as f32 + 0.5 * side as f32) / ratio as f32);
            let [a, b, c, d, e] = coarse.around(centre).map(|p| flow[p]);
            let starts = [a, b, c, d, e, overall].map(|d| d.map(|d| d * ratio as isize));
            matching.best(corner, &starts)
        };
        let flow = (0..grid.len()).map(search).collect();
        parents = Some((grid, flow));
    }
    let Some((grid, flow)) = parents else { return Vec::new() };
    let (image, there) = (&reference.levels[0].image, &other.levels[0].image);
    let starts = flow.iter().map(|start| start.map(|d| d as f32));
    refined([image, there], &grid, starts, variance)
}

/// Displacements of all patches of the first image in the second, refined from `starts`; `variance` as in [`align`].
pub(crate) fn refined(
    [image, there]: [&Frame; 2],
    grid: &Grid,
    starts: impl Iterator<Item = [f32; 2]>,
    variance: f32,
) -> Vec<[f32; 2]> {
    let refined: Vec<Refined> = starts
        .enumerate()
        .map(|(i, start)| refine(image, there, grid.corner(i), start, variance))
        .collect();
    settle(grid, &refined, variance)
}

/// Medians of both components.
fn median(flow: &[[isize; 2]]) -> [isize; 2] {
    std::array::from_fn(|k| {
        let mut values: Vec<isize> = flow.iter().map(|d| d[k]).collect();
        values.sort_unstable();
        values[values.len() / 2]
    })
}

/// The search for one level's patches.
struct Matching<'a> {
    image: &'a Frame,
    there: &'a Frame,
    side: usize,
    radius: isize,
    /// Squared difference that a step of a pixel must win.
    reluctance: f32,
}

impl Matching<'_> {
    /// The displacement of least squared difference within `radius` of the best of `starts`.
    fn best(&self, corner: [usize; 2], starts: &[[isize; 2]]) -> [isize; 2] {
        let mut start = (f32::INFINITY, [0; 2]);
        for (i, &d) in starts.iter().enumerate() {
            let d = self.inside(corner, d);
            let difference = self.difference(corner, d);
            if !starts[..i].contains(&d) && difference < start.0 {
                start = (difference, d);
            }
        }
        let (mut best, start) = (start, start.1);
        for dy in -self.radius..=self.radius {
            for dx in -self.radius..=self.radius {
                let d = self.inside(corner, [start[0] + dx, start[1] + dy]);
                let cost =
                    self.difference(corner, d) + self.reluctance * (dx * dx + dy * dy) as f32;
                if cost < best.0 {
                    best = (cost, d);
                }
            }
        }
        best.1
    }

    /// Kept inside the image: what has left it cannot be found.
    fn inside(&self, corner: [usize; 2], d: [isize; 2]) -> [isize; 2] {
        let size = self.image.size;
        let most = [size.width - self.side, size.height - self.side];
        std::array::from_fn(|k| {
            (corner[k] as isize + d[k]).clamp(0, most[k] as isize) - corner[k] as isize
        })
    }

    fn difference(&self, corner: [usize; 2], d: [isize; 2]) -> f32 {
        let at = [0, 1].map(|k| corner[k].wrapping_add_signed(d[k]));
        squared_difference(self.image, corner, self.there, at, self.side)
    }
}

fn squared_difference(
    a: &Frame,
    [ax, ay]: [usize; 2],
    b: &Frame,
    [bx, by]: [usize; 2],
    side: usize,
) -> f32 {
    let mut lanes = [0.0f32; 8];
    for r in 0..side {
        let (a, b) = (&a.row(ay + r)[ax..ax + side], &b.row(by + r)[bx..bx + side]);
        for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
            for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
                *lane += (a - b) * (a - b);
            }
        }
    }
    lanes.iter().sum()
}

/// A displacement and what is known of it.
struct Refined {
    flow: [f32; 2],
    /// Sums of squared slopes and their product: xx, xy, yy.
    slopes: [f32; 3],
}

/// Steps towards the displacement of least squared difference, from the slopes of the reference.
fn refine(
    image: &Frame,
    there: &Frame,
    [x0, y0]: [usize; 2],
    start: [f32; 2],
    variance: f32,
) -> Refined {
    let (width, height) = (image.size.width, image.size.height);
    let mut slopes_x = [[0.0f32; SIDE]; SIDE];
    let mut slopes_y = slopes_x;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (y, (slopes_x, slopes_y)) in (y0..).zip(slopes_x.iter_mut().zip(&mut slopes_y)) {
        let row = image.row(y);
        let (up, down) = (image.row(y.saturating_sub(1)), image.row((y + 1).min(height - 1)));
        for (x, (sx, sy)) in (x0..).zip(slopes_x.iter_mut().zip(slopes_y)) {
            *sx = 0.5 * (row[(x + 1).min(width - 1)] - row[x.saturating_sub(1)]);
            *sy = 0.5 * (down[x] - up[x]);
            xx += *sx * *sx;
            xy += *sx * *sy;
            yy += *sy * *sy;
        }
    }
    let solve = Damped::new([xx, xy, yy], variance / (STEP_PRIOR * STEP_PRIOR));
    let mut d = start;
    for _ in 0..STEPS {
        let moved = sample(there, [x0 as f32 + d[0], y0 as f32 + d[1]]);
        let (mut bx, mut by) = (0.0, 0.0);
        for (r, moved) in moved.iter().enumerate() {
            let row = &image.row(y0 + r)[x0..x0 + SIDE];
            let slopes = slopes_x[r].iter().zip(&slopes_y[r]);
            for ((moved, here), (sx, sy)) in moved.iter().zip(row).zip(slopes) {
                bx += sx * (moved - here);
                by += sy * (moved - here);
            }
        }
        let step = solve.solve([bx, by]);
        for k in 0..2 {
            let from_start = d[k] - step[k] - start[k];
            d[k] = start[k] + from_start.clamp(-REFINED, REFINED);
        }
    }
    Refined { flow: d, slopes: [xx, xy, yy] }
}

/// Draws every patch towards the median of its neighbourhood, as far as its own slopes leave its
/// motion open: flat patches move with their surroundings.
fn settle(grid: &Grid, refined: &[Refined], variance: f32) -> Vec<[f32; 2]> {
    let mut flow: Vec<[f32; 2]> = refined.iter().map(|patch| patch.flow).collect();
    let ridge = variance / (NEIGHBOURS * NEIGHBOURS);
    for _ in 0..ROUNDS {
        let last = flow.clone();
        for (i, patch) in refined.iter().enumerate() {
            let median = grid.median_around(&last, i);
            let [xx, xy, yy] = patch.slopes;
            let away = [median[0] - patch.flow[0], median[1] - patch.flow[1]];
            let pull = [xx * away[0] + xy * away[1], xy * away[0] + yy * away[1]];
            let back = Damped::new(patch.slopes, ridge).solve(pull);
            flow[i] = [median[0] - back[0], median[1] - back[1]];
        }
    }
    flow
}

/// `(S + ridge I)^-1` of a symmetric 2 x 2 matrix.
struct Damped {
    inverse: [f32; 3],
}

impl Damped {
    /// For `ridge` above 0.
    fn new([xx, xy, yy]: [f32; 3], ridge: f32) -> Self {
        let (xx, yy) = (xx + ridge, yy + ridge);
        let determinant = xx * yy - xy * xy;
        Self { inverse: [yy / determinant, -xy / determinant, xx / determinant] }
    }

    fn solve(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let [xx, xy, yy] = self.inverse;
        [xx * x + xy * y, xy * x + yy * y]
    }
}

/// The patch whose corner is at `corner`, bilinear between pixels, borders repeated.
pub(crate) fn sample(image: &Frame, corner: [f32; 2]) -> [[f32; SIDE]; SIDE] {
    let (width, height) = (image.size.width as isize, image.size.height as isize);
    let [x, y] = corner.map(|c| c.floor() as isize);
    let [fx, fy] = corner.map(|c| c - c.floor());
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let side = SIDE as isize;
    let mut around = [[0.0; SIDE + 1]; SIDE + 1];
    if x >= 0 && y >= 0 && x + side < width && y + side < height {
        for (r, row) in around.iter_mut().enumerate() {
            if let Some(source) = image.row(y as usize + r)[x as usize..].first_chunk() {
                *row = *source;
            }
        }
    } else {
        for (r, row) in around.iter_mut().enumerate() {
            let source = image.row((y + r as isize).clamp(0, height - 1) as usize);
            for (c, value) in row.iter_mut().enumerate() {
                *value = source[(x + c as isize).clamp(0, width - 1) as usize];
            }
        }
    }
    std::array::from_fn(|r| {
        let (upper, lower) = (&around[r], &around[r + 1]);
        std::array::from_fn(|c| {
            upper[c] * weights[0]
                + upper[c + 1] * weights[1]
                + lower[c] * weights[2]
                + lower[c + 1] * weights[3]
        })
    })
}
