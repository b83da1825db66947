//! Statistics of a noisy plane that are robust to its noise: computed from the means of 8 x 8 blocks.

use qudi_core::Frame;

/// Side of a block in pixels.
const SIDE: usize = 8;

/// Range of the block means, and the mean over blocks of a variance function.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spread {
    pub(crate) low: f64,
    pub(crate) high: f64,
    pub(crate) variance: f64,
}

/// Computes the range of the block means of `plane`, and the mean of `variance` over them.
pub(crate) fn spread(plane: &Frame, variance: impl Fn(f64) -> f64) -> Spread {
    let (mut low, mut high, mut total, mut pixels) = (f64::INFINITY, f64::NEG_INFINITY, 0.0, 0);
    for y in (0..plane.size.height).step_by(SIDE) {
        for x in (0..plane.size.width).step_by(SIDE) {
            let (mut sum, mut n) = (0.0, 0);
            for row in y..(y + SIDE).min(plane.size.height) {
                for &v in &plane.row(row)[x..(x + SIDE).min(plane.size.width)] {
                    sum += f64::from(v);
                    n += 1;
                }
            }
            let mean = sum / n as f64;
            low = low.min(mean);
            high = high.max(mean);
            total += variance(mean) * n as f64;
            pixels += n;
        }
    }
    Spread { low, high, variance: total / pixels as f64 }
}
