//! Affine maps between frames, and Gauss-Newton steps that align a frame with another.

use qudi_core::{Frame, Size};

/// Mean squared residual around a pixel, in units of the noise's variance, at which its weight falls to a
/// quarter.
const ROBUST_SCALE: f32 = 1.4;
/// Radius of the square over which residuals are averaged, in pixels.
const RESIDUAL_RADIUS: usize = 2;

/// Prior sigma of a step at the image's border, in pixels.
const STEP_SIGMA: f32 = 0.5;

/// Largest step at the image's border, in pixels.
const MAX_STEP: f64 = 2.0;

/// Minimum number of pixels that two frames must share.
const MIN_SHARED_PIXELS: usize = 64;

/// Weight of the prior that keeps slopes fixed.
const FIXED_SLOPE_WEIGHT: f64 = 1e9;

/// Parameters of a map that a step may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Freedom {
    /// The translation only.
    Shift,
    /// All parameters.
    Affine,
}

/// Number of parameters of an affine map.
const PARAMETERS: usize = 6;

/// An affine map: for each coordinate its constant and its slopes along x and y. Positions are in pixels from
/// the centre of the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Affine([[f32; 3]; 2]);

impl Affine {
    pub(crate) fn shift([x, y]: [f32; 2]) -> Self {
        Self([[x, 1.0, 0.0], [y, 0.0, 1.0]])
    }

    /// Maps a position.
    pub(crate) fn of(self, [x, y]: [f32; 2]) -> [f32; 2] {
        self.0.map(|[constant, along, across]| constant + along * x + across * y)
    }

    /// Applies the inverse map to a position.
    pub(crate) fn inverse_of(self, [x, y]: [f32; 2]) -> [f32; 2] {
        let [[u, a, b], [v, c, d]] = self.0;
        let determinant = a * d - b * c;
        let (x, y) = (x - u, y - v);
        [(d * x - b * y) / determinant, (a * y - c * x) / determinant]
    }

    /// Converts the map to images whose pixels are `times` smaller.
    pub(crate) fn finer(mut self, times: f32) -> Self {
        for numbers in &mut self.0 {
            numbers[0] *= times;
        }
        self
    }

    /// Aligns `frame` with the image that this maps from, with bilinear interpolation. Pixels outside the
    /// frame are NaN.
    pub(crate) fn aligned(self, frame: &Frame) -> Vec<f32> {
        let size = frame.size;
        let centre = centre(size);
        let value = |i: usize| {
            let place = [(i % size.width) as f32, (i / size.width) as f32];
            let [x, y] = self.of([place[0] - centre[0], place[1] - centre[1]]);
            between(frame, x + centre[0], y + centre[1])
        };
        (0..size.pixels()).map(value).collect()
    }

    /// Takes a Gauss-Newton step (Lucas and Kanade 1981) towards the map that aligns a frame with `template`.
    /// `values` is the frame aligned by this map; both have size `size`. The step is robust: pixels that move
    /// differently get little weight, however strong their contrast. Returns `None` if the two share too few
    /// pixels.
    pub(crate) fn stepped(
        self,
        values: &[f32],
        template: &[f32],
        size: Size,
        freedom: Freedom,
    ) -> Option<Self> {
        let differences = values.iter().zip(template).map(|(value, wanted)| (value - wanted).abs());
        let mut known: Vec<f32> = differences.clone().filter(|d| d.is_finite()).collect();
        if known.len() < MIN_SHARED_PIXELS {
            return None;
        }
        let half = known.len() / 2;
        let median = *known.select_nth_unstable_by(half, f32::total_cmp).1;
        let misfit = mean_squares(&differences.collect::<Vec<f32>>(), size);
        let variance = (median / 0.6745).powi(2).max(1e-12);
        let centre = centre(size);
        let border = centre[0].max(centre[1]);
        let mut normal = [[0.0f64; PARAMETERS]; PARAMETERS];
        let mut pull = [0.0f64; PARAMETERS];
        for y in 1..size.height - 1 {
            for x in 1..size.width - 1 {
                let i = y * size.width + x;
                let residual = values[i] - template[i];
                let across = 0.5 * (template[i + 1] - template[i - 1]);
                let down = 0.5 * (template[i + size.width] - template[i - size.width]);
                if (residual + across + down).is_nan() {
                    continue;
                }
                let excess = misfit[i] / (ROBUST_SCALE * variance);
                let weight = 1.0 / (1.0 + excess * excess);
                let weight = f64::from(weight * weight);
                let from = [(x as f32 - centre[0]) / border, (y as f32 - centre[1]) / border];
                let slopes = [across, down].map(|s| [s, s * from[0], s * from[1]].map(f64::from));
                let slopes = slopes.as_flattened();
                for (p, slope) in slopes.iter().enumerate() {
                    pull[p] += weight * slope * f64::from(residual);
                    for (q, other) in slopes.iter().enumerate().take(p + 1) {
                        normal[p][q] += weight * slope * other;
                    }
                }
            }
        }
        for (p, row) in normal.iter_mut().enumerate() {
            let slope = p % 3 > 0;
            let stiff = if slope && freedom == Freedom::Shift { FIXED_SLOPE_WEIGHT } else { 0.0 };
            row[p] += f64::from(variance / (STEP_SIGMA * STEP_SIGMA)) + stiff;
        }
        let step = solved(normal, pull)?;
        let mut next = self;
        for (numbers, step) in next.0.iter_mut().zip(step.chunks_exact(3)) {
            for (p, (number, step)) in numbers.iter_mut().zip(step).enumerate() {
                let unit = if p == 0 { 1.0 } else { border };
                *number -= step.clamp(-MAX_STEP, MAX_STEP) as f32 / unit;
            }
        }
        Some(next)
    }
}

/// Returns the origin of the maps' coordinates: the centre of the image.
pub(crate) fn centre(size: Size) -> [f32; 2] {
    [size.width, size.height].map(|side| 0.5 * (side as f32 - 1.0))
}

/// Computes the mean square around every pixel, over the finite values.
fn mean_squares(values: &[f32], size: Size) -> Vec<f32> {
    let Size { height, width } = size;
    let near = |at: usize, length: usize| {
        at.saturating_sub(RESIDUAL_RADIUS)..(at + RESIDUAL_RADIUS + 1).min(length)
    };
    let add = |sums: &mut [[f32; 2]], values: &[[f32; 2]]| {
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum = [sum[0] + value[0], sum[1] + value[1]];
        }
    };
    let squares = values.iter().map(|v| if v.is_finite() { [v * v, 1.0] } else { [0.0; 2] });
    let squares: Vec<[f32; 2]> = squares.collect();
    let mut rows = vec![[0.0; 2]; values.len()];
    for (sums, squares) in rows.chunks_exact_mut(width).zip(squares.chunks_exact(width)) {
        // `shift` is the offset to the right of the summed value plus `RESIDUAL_RADIUS`.
        for shift in
            (0..=2 * RESIDUAL_RADIUS).filter(|shift| shift.abs_diff(RESIDUAL_RADIUS) < width)
        {
            let (skipped, from) =
                (RESIDUAL_RADIUS.saturating_sub(shift), shift.saturating_sub(RESIDUAL_RADIUS));
            add(&mut sums[skipped..], &squares[from..]);
        }
    }
    let mut means = Vec::with_capacity(values.len());
    for y in 0..height {
        let mut sums = vec![[0.0; 2]; width];
        for y in near(y, height) {
            add(&mut sums, &rows[y * width..][..width]);
        }
        means.extend(sums.iter().map(|[sum, count]| sum / count.max(1.0)));
    }
    means
}

/// Interpolates bilinearly; returns NaN outside the frame.
fn between(frame: &Frame, x: f32, y: f32) -> f32 {
    let Size { height, width } = frame.size;
    if !(x >= 0.0 && y >= 0.0 && x < (width - 1) as f32 && y < (height - 1) as f32) {
        return f32::NAN;
    }
    let (left, top) = (x as usize, y as usize);
    let [upper, lower] = [top, top + 1].map(|row| {
        let pair = &frame.row(row)[left..left + 2];
        pair[0] + (x - left as f32) * (pair[1] - pair[0])
    });
    upper + (y - top as f32) * (lower - upper)
}

/// Solves a symmetric positive definite system by Cholesky factorization. Only the lower half of `matrix` is
/// read.
fn solved(
    mut matrix: [[f64; PARAMETERS]; PARAMETERS],
    mut x: [f64; PARAMETERS],
) -> Option<[f64; PARAMETERS]> {
    for p in 0..PARAMETERS {
        for q in 0..=p {
            let sum: f64 = (0..q).map(|r| matrix[p][r] * matrix[q][r]).sum();
            let rest = matrix[p][q] - sum;
            if p > q {
                matrix[p][q] = rest / matrix[q][q];
            } else if rest > 0.0 {
                matrix[p][p] = rest.sqrt();
            } else {
                return None;
            }
        }
        let sum: f64 = (0..p).map(|r| matrix[p][r] * x[r]).sum();
        x[p] = (x[p] - sum) / matrix[p][p];
    }
    for p in (0..PARAMETERS).rev() {
        let sum: f64 = (p + 1..PARAMETERS).map(|r| matrix[r][p] * x[r]).sum();
        x[p] = (x[p] - sum) / matrix[p][p];
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backward_warp_is_the_adjoint_of_forward() {
        let map = Affine([[3.0, 1.02, -0.03], [-2.0, 0.05, 0.97]]);
        for place in [[0.0, 0.0], [40.0, -25.0], [-17.5, 60.0]] {
            let back = map.inverse_of(map.of(place));
            assert!(back.iter().zip(&place).all(|(a, b)| (a - b).abs() < 1e-4), "{back:?}");
        }
    }

    #[test]
    fn solves_linear_systems() {
        let row =
            |p: usize| std::array::from_fn(|q| if p == q { 4.0 } else { 1.0 / (p + q) as f64 });
        let matrix: [[f64; PARAMETERS]; PARAMETERS] = std::array::from_fn(row);
        let wanted: [f64; PARAMETERS] = std::array::from_fn(|p| p as f64 - 2.5);
        let right = matrix.map(|row| row.iter().zip(&wanted).map(|(a, x)| a * x).sum());
        let found = solved(matrix, right).unwrap_or_else(|| panic!("it is positive"));
        assert!(found.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
        assert!(solved([[0.0; PARAMETERS]; PARAMETERS], right).is_none());
    }
}
