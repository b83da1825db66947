//! Metrics of colour frames: red, green and blue together.

use super::MAX_PSNR;
use crate::frame::Frame;

/// Share of the pixels, the ones where the truth is steepest, at which zipper errors are measured.
const EDGE_SHARE: f64 = 0.1;

/// Returns the one factor on all planes of `estimate` with the least squared error; 1 where one is black.
pub fn common_gain(estimate: &[Frame; 3], truth: &[Frame; 3]) -> f64 {
    let (mut cross, mut square) = (0.0, 0.0);
    for (estimate, truth) in estimate.iter().zip(truth) {
        for (&e, &t) in estimate.data.iter().zip(&truth.data) {
            cross += f64::from(e) * f64::from(t);
            square += f64::from(e) * f64::from(e);
        }
    }
    if square > 0.0 && cross > 0.0 { cross / square } else { 1.0 }
}

/// Returns the PSNR over red, green and blue together (CPSNR), at most [`MAX_PSNR`]; `estimate` is multiplied
/// with `gain`, and values are passed through `curve` after both are clipped to [0, 1].
pub fn colour_psnr(
    estimate: &[Frame; 3],
    truth: &[Frame; 3],
    gain: f64,
    curve: impl Fn(f32) -> f32,
) -> f64 {
    let (mut sum, mut samples) = (0.0, 0.0);
    for (estimate, truth) in estimate.iter().zip(truth) {
        for (&e, &t) in estimate.data.iter().zip(&truth.data) {
            let e = curve((gain as f32 * e).clamp(0.0, 1.0));
            let difference = f64::from(e) - f64::from(curve(t.clamp(0.0, 1.0)));
            sum += difference * difference;
            samples += 1.0;
        }
    }
    (-10.0 * (sum / samples).log10()).min(MAX_PSNR)
}

/// Returns the zipper error: the root of the mean square of the part of the error that alternates from pixel
/// to pixel, along rows and columns, at edges of the truth. `estimate` is multiplied with `gain`.
pub fn zipper_error(estimate: &[Frame; 3], truth: &[Frame; 3], gain: f64) -> f64 {
    let size = truth[0].size;
    if size.height < 3 || size.width < 3 {
        return 0.0;
    }
    let inner = |i: &usize| {
        let (x, y) = (i % size.width, i / size.width);
        x > 0 && y > 0 && x + 1 < size.width && y + 1 < size.height
    };
    let steepness = |i: usize| -> f32 {
        let of = |t: &Frame| {
            let along = |step: usize| (t.data[i + step] - t.data[i - step]).powi(2);
            along(1) + along(size.width)
        };
        truth.iter().map(of).sum()
    };
    let mut places: Vec<(f32, usize)> =
        (0..size.pixels()).filter(inner).map(|i| (steepness(i), i)).collect();
    places.sort_by(|a, b| b.0.total_cmp(&a.0));
    places.truncate(((EDGE_SHARE * places.len() as f64).ceil() as usize).max(1));
    let (mut sum, mut samples) = (0.0, 0.0);
    for (estimate, truth) in estimate.iter().zip(truth) {
        let error = |i: usize| gain * f64::from(estimate.data[i]) - f64::from(truth.data[i]);
        for &(_, i) in &places {
            for step in [1, size.width] {
                let alternating = (2.0 * error(i) - error(i - step) - error(i + step)) / 4.0;
                sum += alternating * alternating;
                samples += 1.0;
            }
        }
    }
    f64::sqrt(sum / samples)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    const SIZE: Size = Size { height: 16, width: 20 };

    fn scene() -> [Frame; 3] {
        [0.2, 0.3, 0.4].map(|v| Frame::from_fn(SIZE, |x, _| if x < 10 { v } else { 2.0 * v }))
    }

    #[test]
    fn one_gain_is_forgiven_and_three_are_not() {
        let truth = scene();
        let scaled = |factors: [f32; 3]| -> [Frame; 3] {
            std::array::from_fn(|k| {
                let data = truth[k].data.iter().map(|v| v * factors[k]).collect();
                Frame { size: SIZE, data }
            })
        };
        let score = |estimate: &[Frame; 3]| {
            colour_psnr(estimate, &truth, common_gain(estimate, &truth), |v| v)
        };
        assert!(score(&scaled([0.5; 3])) > 90.0);
        assert!(score(&scaled([0.5, 0.5, 0.4])) < 35.0);
    }

    #[test]
    fn zippers_are_errors_of_period_two() {
        let truth = scene();
        let with = |error: &dyn Fn(usize) -> f32| -> [Frame; 3] {
            truth.clone().map(|plane| Frame::from_fn(SIZE, |x, y| plane.row(y)[x] + error(x)))
        };
        let alternating = with(&|x| if x % 2 == 0 { 0.02 } else { -0.02 });
        let smooth = with(&|x| 0.002 * x as f32);
        assert!((zipper_error(&alternating, &truth, 1.0) - 0.02 / f64::sqrt(2.0)).abs() < 1e-4);
        assert!(zipper_error(&smooth, &truth, 1.0) < 1e-4);
    }
}
