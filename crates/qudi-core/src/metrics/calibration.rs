//! Calibration of the predicted uncertainty: overall, in flat parts and in textured parts.

use super::detail::{SIDE, quarters};
use crate::frame::Frame;

/// Ratio of the root mean square error to the root mean square predicted sigma: 1 where the prediction is
/// right, above 1 where it is too small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Ratio over the whole frame.
    pub all: f64,
    /// Ratio in the quarter of the squares of 16 x 16 pixels in which the truth has least detail.
    pub flat: f64,
    /// Ratio in the quarter in which the truth has most detail.
    pub textured: f64,
}

/// Compares `sigma` with the errors of an image. Returns `None` for frames of different sizes or of fewer
/// than four squares, or where sigma is zero.
pub fn calibration(image: &Frame, sigma: &Frame, truth: &Frame) -> Option<Calibration> {
    if image.size != truth.size || sigma.size != truth.size {
        return None;
    }
    let width = truth.size.width;
    let ratio = |squares: &[[usize; 2]], height: usize, columns: usize| {
        let (mut errors, mut predicted) = (0.0, 0.0);
        for &[top, left] in squares {
            for y in top..top + height {
                for i in y * width + left..y * width + left + columns {
                    errors += f64::from(image.data[i] - truth.data[i]).powi(2);
                    predicted += f64::from(sigma.data[i]).powi(2);
                }
            }
        }
        (predicted > 0.0).then(|| (errors / predicted).sqrt())
    };
    let [flat, textured] = quarters(truth)?;
    Some(Calibration {
        all: ratio(&[[0, 0]], truth.size.height, width)?,
        flat: ratio(&flat, SIDE, SIDE)?,
        textured: ratio(&textured, SIDE, SIDE)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    #[test]
    fn errors_are_compared_with_their_sigma_where_they_are() {
        let size = Size { height: 32, width: 64 };
        let truth = Frame::from_fn(size, |x, y| {
            let stripes = if x < 32 { 0.0 } else { 0.3 * (x / 2 % 2) as f32 };
            0.2 + 0.001 * y as f32 + stripes
        });
        // Errors of 0.02 on the left and 0.06 on the right; 0.04 is predicted.
        let error = |x: usize, y: usize| {
            let size = if x < 32 { 0.02 } else { 0.06 };
            if (x + y).is_multiple_of(2) { size } else { -size }
        };
        let image = Frame::from_fn(size, |x, y| truth.data[y * 64 + x] + error(x, y));
        let sigma = Frame::filled(size, 0.04);
        let Some(found) = calibration(&image, &sigma, &truth) else { panic!("large enough") };
        let expected = [(0.0004f64 + 0.0036).sqrt() / 2f64.sqrt() / 0.04, 0.5, 1.5];
        for (found, expected) in [found.all, found.flat, found.textured].into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-4, "{found} for {expected}");
        }
        assert_eq!(calibration(&image, &Frame::filled(size, 0.0), &truth), None);
    }
}
