//! Subpixel refinement of patch displacements with Lucas and Kanade's steps ("An iterative image registration
//! technique", IJCAI 1981), and their regularization: patches without texture move with their surroundings.

use super::grid::Grid;
use crate::patch::{BilinearSamples, Patch, SIDE};
use multiversion::multiversion;
use qudi_core::Frame;

/// Number of refinement steps, as in the authors' experiments.
const STEPS: usize = 3;

/// Prior sigma of the refinement, in pixels.
const STEP_SIGMA: f32 = 0.5;

/// Prior sigma of the difference between a patch's motion and its neighbours' motion, in pixels.
const NEIGHBOUR_SIGMA: f32 = 0.25;

/// Iterations of the regularization; each propagates motion by one patch.
const ITERATIONS: usize = 4;

/// Maximum total displacement by refinement, in pixels.
const MAX_REFINEMENT: f32 = 1.0;

/// Refines the displacements `starts` of all patches of the first image in the second. `variance` is the
/// noise variance of the difference of two pixels.
pub(crate) fn refine(
    [image, there]: [&Frame; 2],
    grid: &Grid,
    starts: impl Iterator<Item = [f32; 2]>,
    variance: f32,
) -> Vec<[f32; 2]> {
    let refined: Vec<Refined> = starts
        .enumerate()
        .map(|(i, start)| refine_patch(image, there, grid.corner(i), start, variance))
        .collect();
    regularize(grid, &refined, variance)
}

/// A refined displacement, and how well the patch's texture determines it.
struct Refined {
    flow: [f32; 2],
    /// Structure tensor: sums of the gradient's products xx, xy and yy.
    slopes: [f32; 3],
}

/// Takes Gauss-Newton steps towards the displacement of least squared difference, with the gradients of
/// `image`.
#[multiversion(targets("x86_64+avx2"))]
fn refine_patch(
    image: &Frame,
    there: &Frame,
    [x0, y0]: [usize; 2],
    start: [f32; 2],
    variance: f32,
) -> Refined {
    let height = image.size.height;
    let [mut slopes_x, mut slopes_y, mut own] = [[[0.0f32; SIDE]; SIDE]; 3];
    for r in 0..SIDE {
        let y = y0 + r;
        let row = image.row(y);
        let (up, down) = (image.row(y.saturating_sub(1)), image.row((y + 1).min(height - 1)));
        own[r].copy_from_slice(&row[x0..x0 + SIDE]);
        if x0 > 0 && x0 + SIDE < row.len() {
            slopes_x[r] = half_difference(&row[x0 + 1..x0 + 1 + SIDE], &row[x0 - 1..x0 - 1 + SIDE]);
        } else {
            // The last pixel before a border is its own neighbour.
            let at = |x: usize| row[x.min(row.len() - 1)];
            let right: [f32; SIDE] = std::array::from_fn(|c| at(x0 + c + 1));
            let left: [f32; SIDE] = std::array::from_fn(|c| at((x0 + c).saturating_sub(1)));
            slopes_x[r] = half_difference(&right, &left);
        }
        slopes_y[r] = half_difference(&down[x0..x0 + SIDE], &up[x0..x0 + SIDE]);
    }
    let [xx, xy, yy] = [(&slopes_x, &slopes_x), (&slopes_x, &slopes_y), (&slopes_y, &slopes_y)]
        .map(|(a, b)| total_product(a, b));
    let solve = Damped::new([xx, xy, yy], variance / (STEP_SIGMA * STEP_SIGMA));
    let mut d = start;
    for _ in 0..STEPS {
        let moved = BilinearSamples::new(there, [x0 as f32 + d[0], y0 as f32 + d[1]]);
        // Sums of the products of slopes and difference, sixteen at a time.
        let (mut along_x, mut along_y) = ([0.0f32; SIDE], [0.0f32; SIDE]);
        for r in 0..SIDE {
            let row = moved.row(r);
            for c in 0..SIDE {
                let away = row[c] - own[r][c];
                along_x[c] += slopes_x[r][c] * away;
                along_y[c] += slopes_y[r][c] * away;
            }
        }
        let step = solve.solve([along_x.iter().sum(), along_y.iter().sum()]);
        for k in 0..2 {
            let from_start = d[k] - step[k] - start[k];
            d[k] = start[k] + from_start.clamp(-MAX_REFINEMENT, MAX_REFINEMENT);
        }
    }
    Refined { flow: d, slopes: [xx, xy, yy] }
}

#[inline(always)]
fn half_difference(a: &[f32], b: &[f32]) -> [f32; SIDE] {
    let (a, b) = (&a[..SIDE], &b[..SIDE]);
    let mut row = [0.0; SIDE];
    for c in 0..SIDE {
        row[c] = 0.5 * (a[c] - b[c]);
    }
    row
}

/// Returns the sum of the products of two patches' samples, computed sixteen at a time.
#[inline(always)]
fn total_product(a: &Patch, b: &Patch) -> f32 {
    let mut lanes = [0.0f32; SIDE];
    for (a, b) in a.iter().zip(b) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    lanes.iter().sum()
}

/// Regularizes the motion: each patch is drawn towards the median motion of its neighbourhood, as far as its
/// own gradients leave its motion undetermined.
fn regularize(grid: &Grid, refined: &[Refined], variance: f32) -> Vec<[f32; 2]> {
    let mut flow: Vec<[f32; 2]> = refined.iter().map(|patch| patch.flow).collect();
    let ridge = variance / (NEIGHBOUR_SIGMA * NEIGHBOUR_SIGMA);
    for _ in 0..ITERATIONS {
        let medians = grid.medians(&flow);
        for (i, (patch, median)) in refined.iter().zip(medians).enumerate() {
            let [xx, xy, yy] = patch.slopes;
            let away = [median[0] - patch.flow[0], median[1] - patch.flow[1]];
            let pull = [xx * away[0] + xy * away[1], xy * away[0] + yy * away[1]];
            let back = Damped::new(patch.slopes, ridge).solve(pull);
            flow[i] = [median[0] - back[0], median[1] - back[1]];
        }
    }
    flow
}

/// The inverse `(S + ridge I)^-1` of a symmetric 2 x 2 matrix `S`.
struct Damped {
    inverse: [f32; 3],
}

impl Damped {
    /// Inverts the matrix of entries xx, xy and yy; `ridge` must be positive.
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
