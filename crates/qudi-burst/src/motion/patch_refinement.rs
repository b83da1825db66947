//! Refinement of patch displacements below a pixel by Lucas and Kanade's steps ("An iterative image
//! registration technique", IJCAI 1981), and their regularization: flat patches move with their surroundings.

use super::grid::Grid;
use crate::patch::{SIDE, bilinear};
use qudi_core::Frame;

/// Steps of the refinement, as in the authors' experiments.
const STEPS: usize = 3;

/// Prior sigma of the refinement, in pixels.
const STEP_SIGMA: f32 = 0.5;

/// Prior sigma of a patch's motion around that of its neighbours, in pixels.
const NEIGHBOUR_SIGMA: f32 = 0.25;

/// Iterations of the regularization; each hands motion on by one patch.
const ITERATIONS: usize = 4;

/// The farthest that refinement may move a patch in all, in pixels.
const LONGEST: f32 = 1.0;

/// Refines the displacements `starts` of all patches of the first image in the second. `variance` is that of
/// the noise of any two pixels' difference.
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

/// A refined displacement and how well the patch's texture determines it.
struct Refined {
    flow: [f32; 2],
    /// The structure tensor: sums of the gradient's products xx, xy and yy.
    slopes: [f32; 3],
}

/// Takes Gauss-Newton steps towards the displacement of least squared difference, with the gradients of
/// `image`.
fn refine_patch(
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
    let solve = Damped::new([xx, xy, yy], variance / (STEP_SIGMA * STEP_SIGMA));
    let mut d = start;
    for _ in 0..STEPS {
        let moved = bilinear(there, [x0 as f32 + d[0], y0 as f32 + d[1]]);
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
            d[k] = start[k] + from_start.clamp(-LONGEST, LONGEST);
        }
    }
    Refined { flow: d, slopes: [xx, xy, yy] }
}

/// Draws every patch towards the median motion of its neighbourhood, as far as its own gradients leave its
/// motion open.
fn regularize(grid: &Grid, refined: &[Refined], variance: f32) -> Vec<[f32; 2]> {
    let mut flow: Vec<[f32; 2]> = refined.iter().map(|patch| patch.flow).collect();
    let ridge = variance / (NEIGHBOUR_SIGMA * NEIGHBOUR_SIGMA);
    for _ in 0..ITERATIONS {
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

/// The inverse `(S + ridge I)^-1` of a symmetric 2 x 2 matrix `S`.
struct Damped {
    inverse: [f32; 3],
}

impl Damped {
    /// Inverts the matrix of entries xx, xy and yy; `ridge` is above 0.
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
