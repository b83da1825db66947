//! Patch matching: finds each patch of a reference in another block of frames (Ma et al. 2020, section 5.1).
//!
//! The search runs from coarse to fine. Every patch starts at the best of its parent's displacement, the
//! displacements of the parent's neighbours and the median of all, and searches around it. At the finest
//! level, steps of Lucas and Kanade (1981) refine the displacement to subpixel precision.

use super::grid::Grid;
use super::patch_refinement::refine;
use super::pyramid::{Level, Pyramid};
use multiversion::multiversion;
use qudi_core::Frame;

/// Cost in nats of moving one pixel squared from the start of the search, at each level, finest first. It
/// makes a patch with little texture follow its parent. The coarsest level has no parent and a lower cost.
const STEP_COST: [f32; 3] = [0.5, 0.5, 0.1];

/// Search radius in pixels at each level, finest first.
const RADII: [isize; 3] = [1, 4, 8];

/// Finds the displacement of every patch of `reference` in `other`, in pixels, right and down. `variance` is
/// the noise variance of the difference of two pixels.
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
            // A squared difference in nats is divided by twice the variance.
            step_cost: STEP_COST[number] * 2.0 * noise,
        };
        // The camera's own motion serves patches whose parent had too little texture.
        let overall = parents.as_ref().map_or([0; 2], |(_, flow)| median(flow));
        let search = |i: usize| {
            let corner = grid.corner(i);
            let Some((coarse, flow)) = &parents else { return best(&matching, corner, &[[0; 2]]) };
            let centre = corner.map(|c| (c as f32 + 0.5 * side as f32) / ratio as f32);
            let [a, b, c, d, e] = coarse.around(centre).map(|p| flow[p]);
            let starts = [a, b, c, d, e, overall].map(|d| d.map(|d| d * ratio as isize));
            best(&matching, corner, &starts)
        };
        let flow = (0..grid.len()).map(search).collect();
        parents = Some((grid, flow));
    }
    let Some((grid, flow)) = parents else { return Vec::new() };
    let (image, there) = (&reference.levels[0].image, &other.levels[0].image);
    let starts = flow.iter().map(|start| start.map(|d| d as f32));
    refine([image, there], &grid, starts, variance)
}

/// Returns the medians of both components.
fn median(flow: &[[isize; 2]]) -> [isize; 2] {
    std::array::from_fn(|k| {
        let mut values: Vec<isize> = flow.iter().map(|d| d[k]).collect();
        values.sort_unstable();
        values[values.len() / 2]
    })
}

/// Finds the displacement of least squared difference within `radius` of the best of `starts`.
#[multiversion(targets("x86_64+avx2"))]
fn best<'a>(matching: &Matching<'a>, corner: [usize; 2], starts: &[[isize; 2]]) -> [isize; 2] {
    let mut start = (f32::INFINITY, [0; 2]);
    for (i, &d) in starts.iter().enumerate() {
        let d = matching.inside(corner, d);
        let difference = matching.difference(corner, d);
        if !starts[..i].contains(&d) && difference < start.0 {
            start = (difference, d);
        }
    }
    let (mut best, start) = (start, start.1);
    for dy in -matching.radius..=matching.radius {
        for dx in -matching.radius..=matching.radius {
            let d = matching.inside(corner, [start[0] + dx, start[1] + dy]);
            let cost =
                matching.difference(corner, d) + matching.step_cost * (dx * dx + dy * dy) as f32;
            if cost < best.0 {
                best = (cost, d);
            }
        }
    }
    best.1
}

/// Search for the patches of one level.
struct Matching<'a> {
    image: &'a Frame,
    there: &'a Frame,
    side: usize,
    radius: isize,
    /// Squared difference that a step of one pixel costs.
    step_cost: f32,
}

impl Matching<'_> {
    /// Clamps the displacement so that the patch stays inside the image.
    #[inline(always)]
    fn inside(&self, corner: [usize; 2], d: [isize; 2]) -> [isize; 2] {
        let size = self.image.size;
        let most = [size.width - self.side, size.height - self.side];
        std::array::from_fn(|k| {
            (corner[k] as isize + d[k]).clamp(0, most[k] as isize) - corner[k] as isize
        })
    }

    #[inline(always)]
    fn difference(&self, corner: [usize; 2], d: [isize; 2]) -> f32 {
        let at = [0, 1].map(|k| corner[k].wrapping_add_signed(d[k]));
        squared_difference(self.image, corner, self.there, at, self.side)
    }
}

#[inline(always)]
fn squared_difference(
    a: &Frame,
    [ax, ay]: [usize; 2],
    b: &Frame,
    [bx, by]: [usize; 2],
    side: usize,
) -> f32 {
    // Two chains of additions, so that none waits for the one before.
    let mut lanes = [[0.0f32; 8]; 2];
    for r in 0..side {
        let lanes = &mut lanes[r % 2];
        let (a, b) = (&a.row(ay + r)[ax..ax + side], &b.row(by + r)[bx..bx + side]);
        for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
            for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
                *lane += (a - b) * (a - b);
            }
        }
    }
    lanes.as_flattened().iter().sum()
}
