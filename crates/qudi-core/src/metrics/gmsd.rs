//! Gradient magnitude similarity deviation (Xue et al. 2014, "Gradient Magnitude Similarity Deviation: A
//! Highly Efficient Perceptual Image Quality Index").

use crate::frame::{Frame, Size};

/// The authors' constant of 170, for images in [0, 1] instead of 8 bits.
const STABILITY: f64 = 170.0 / (255.0 * 255.0);

/// Returns the standard deviation of the gradient magnitude similarity: 0 for equal images, larger for worse
/// ones. Both are clipped to [0, 1]. `None` for frames of different sizes or without a square of 2 x 2
/// pixels.
///
/// As in the authors' program, means of squares of 2 x 2 pixels are compared, gradients are Prewitt's, and
/// images are dark outside.
pub fn gmsd(estimate: &Frame, truth: &Frame) -> Option<f64> {
    if estimate.size != truth.size || truth.size.height < 2 || truth.size.width < 2 {
        return None;
    }
    let (size, a) = gradients(estimate);
    let (_, b) = gradients(truth);
    let similarity =
        a.iter().zip(&b).map(|(a, b)| (2.0 * a * b + STABILITY) / (a * a + b * b + STABILITY));
    let similarity: Vec<f64> = similarity.collect();
    let count = size.pixels() as f64;
    let mean = similarity.iter().sum::<f64>() / count;
    let squares = similarity.iter().map(|s| (s - mean).powi(2)).sum::<f64>();
    // Sample standard deviation, as MATLAB's std2.
    Some((squares / (count - 1.0).max(1.0)).sqrt())
}

/// Computes the lengths of the gradients of an image at half its size.
fn gradients(frame: &Frame) -> (Size, Vec<f64>) {
    let Size { height, width } = frame.size;
    // An odd last row or column is averaged with zeros.
    let size = Size { height: height.div_ceil(2), width: width.div_ceil(2) };
    let value = |y: usize, x: usize| {
        if y < height && x < width {
            f64::from(frame.data[y * width + x].clamp(0.0, 1.0))
        } else {
            0.0
        }
    };
    let half: Vec<f64> = (0..size.pixels())
        .map(|i| {
            let (y, x) = (2 * (i / size.width), 2 * (i % size.width));
            0.25 * (value(y, x) + value(y, x + 1) + value(y + 1, x) + value(y + 1, x + 1))
        })
        .collect();
    let at = |y: usize, x: usize| {
        // Shifted by one: 0 is the row or column before the first.
        let inside = (1..=size.height).contains(&y) && (1..=size.width).contains(&x);
        if inside { half[(y - 1) * size.width + x - 1] } else { 0.0 }
    };
    let lengths = (0..size.pixels()).map(|i| {
        let (y, x) = (i / size.width + 1, i % size.width + 1);
        let across: f64 = (y - 1..=y + 1).map(|y| at(y, x + 1) - at(y, x - 1)).sum();
        let down: f64 = (x - 1..=x + 1).map(|x| at(y + 1, x) - at(y - 1, x)).sum();
        (across / 3.0).hypot(down / 3.0)
    });
    (size, lengths.collect())
}
