//! Where each patch of a reference lies in another block of frames (Ma et al. 2020, section 5.1).
//!
//! From coarse to fine, every patch starts at the best of what its parent and the parent's
//! neighbours found, and searches around it; at the finest level, steps of Lucas and Kanade (1981)
//! refine it below a pixel.

use super::dft::SIDE;
use super::grid::Grid;
use super::pyramid::{Level, Pyramid};
use qudi_sim::Frame;

/// Search radius at each level, finest first, in its pixels.
const RADII: [isize; 3] = [1, 4, 8];

/// Side of the patches at each level.
const SIDES: [usize; 3] = [SIDE, SIDE, 8];

/// Refining steps (FIELD 6.2: numLKIters).
const STEPS: usize = 3;

/// How far refining may move a patch in all, in pixels.
const REFINED: f32 = 1.0;

/// Patches of the finest level: half of each overlaps the next.
pub(super) fn finest_grid(size: qudi_sim::Size) -> Grid {
    Grid::new(size, SIDE, SIDE / 2)
}

/// The displacement of every patch of `reference` in `other`, in pixels, right and down. `variance` is
/// that of the smoothed counts' noise: steps of refining that it could explain are shortened.
pub(super) fn align(reference: &Pyramid, other: &Pyramid, variance: f32) -> Vec<[f32; 2]> {
    let mut parents: Option<(Grid, Vec<[isize; 2]>)> = None;
    for (number, (level, there)) in reference.levels.iter().zip(&other.levels).enumerate().rev() {
        let side = SIDES[number];
        let step = if number == 0 { side / 2 } else { side };
        let ratio = reference.levels.get(number + 1).map_or(1, |coarser: &Level| coarser.ratio);
        let grid = Grid::new(level.image.size, side, step);
        let search = |i: usize| {
            let corner = grid.corner(i);
            let starts = parents.as_ref().map_or([[0; 2]; 5], |(coarse, flow)| {
                let centre = corner.map(|c| (c as f32 + 0.5 * side as f32) / ratio as f32);
                coarse.around(centre).map(|p| flow[p].map(|d| d * ratio as isize))
            });
            best_match(&level.image, &there.image, corner, side, starts, RADII[number])
        };
        let flow = (0..grid.len()).map(search).collect();
        parents = Some((grid, flow));
    }
    let Some((grid, flow)) = parents else { return Vec::new() };
    let (image, there) = (&reference.levels[0].image, &other.levels[0].image);
    let refined =
        |(i, start): (usize, &[isize; 2])| refine(image, there, grid.corner(i), *start, variance);
    flow.iter().enumerate().map(refined).collect()
}

/// The displacement of least squared difference within `radius` of the best of `starts`.
fn best_match(
    image: &Frame,
    there: &Frame,
    corner: [usize; 2],
    side: usize,
    starts: [[isize; 2]; 5],
    radius: isize,
) -> [isize; 2] {
    // Kept inside the image: what has left it cannot be found.
    let inside = |d: [isize; 2]| {
        let most = [image.size.width - side, image.size.height - side];
        std::array::from_fn(|k| {
            (corner[k] as isize + d[k]).clamp(0, most[k] as isize) - corner[k] as isize
        })
    };
    let mut best = (f32::INFINITY, [0; 2]);
    let mut consider = |d: [isize; 2]| {
        let d: [isize; 2] = inside(d);
        let at = [0, 1].map(|k| corner[k].wrapping_add_signed(d[k]));
        let difference = squared_difference(image, corner, there, at, side);
        if difference < best.0 {
            best = (difference, d);
        }
        best.1
    };
    let mut start = [0; 2];
    for (i, &d) in starts.iter().enumerate() {
        if !starts[..i].contains(&d) {
            start = consider(d);
        }
    }
    for dy in -radius..=radius {
        for dx in -radius..=radius {
            consider([start[0] + dx, start[1] + dy]);
        }
    }
    best.1
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

/// Steps towards the displacement of least squared difference, from the slopes of the reference.
fn refine(
    image: &Frame,
    there: &Frame,
    [x0, y0]: [usize; 2],
    start: [isize; 2],
    variance: f32,
) -> [f32; 2] {
    let (width, height) = (image.size.width, image.size.height);
    let mut slopes = [[[0.0f32; SIDE]; SIDE]; 2];
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for r in 0..SIDE {
        let y = y0 + r;
        let row = image.row(y);
        let (up, down) = (image.row(y.saturating_sub(1)), image.row((y + 1).min(height - 1)));
        for c in 0..SIDE {
            let x = x0 + c;
            let dx = 0.5 * (row[(x + 1).min(width - 1)] - row[x.saturating_sub(1)]);
            let dy = 0.5 * (down[x] - up[x]);
            slopes[0][r][c] = dx;
            slopes[1][r][c] = dy;
            xx += dx * dx;
            xy += dx * dy;
            yy += dy * dy;
        }
    }
    // Ridge: as if the displacement were known to within half a pixel beforehand.
    let ridge = 4.0 * variance;
    xx += ridge;
    yy += ridge;
    let determinant = xx * yy - xy * xy;
    let mut d = start.map(|d| d as f32);
    if determinant.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
        return d;
    }
    for _ in 0..STEPS {
        let moved = sample(there, [x0 as f32 + d[0], y0 as f32 + d[1]]);
        let (mut bx, mut by) = (0.0, 0.0);
        for r in 0..SIDE {
            let row = &image.row(y0 + r)[x0..x0 + SIDE];
            for c in 0..SIDE {
                let difference = moved[r][c] - row[c];
                bx += slopes[0][r][c] * difference;
                by += slopes[1][r][c] * difference;
            }
        }
        let step = [(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant];
        for k in 0..2 {
            let from_start = d[k] - step[k] - start[k] as f32;
            d[k] = start[k] as f32 + from_start.clamp(-REFINED, REFINED);
        }
    }
    d
}

/// The patch whose corner is at `corner`, bilinear between pixels, borders repeated.
pub(super) fn sample(image: &Frame, corner: [f32; 2]) -> [[f32; SIDE]; SIDE] {
    let (width, height) = (image.size.width as isize, image.size.height as isize);
    let [x, y] = corner.map(|c| c.floor() as isize);
    let [fx, fy] = corner.map(|c| c - c.floor());
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let side = SIDE as isize;
    let mut around = [[0.0; SIDE + 1]; SIDE + 1];
    if x >= 0 && y >= 0 && x + side < width && y + side < height {
        for (r, row) in around.iter_mut().enumerate() {
            row.copy_from_slice(&image.row(y as usize + r)[x as usize..=x as usize + SIDE]);
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
