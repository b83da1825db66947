//! Structural similarity (Wang et al. 2004), in the two forms that the field's tables use.

use crate::frame::{Frame, Size};

const K1: f64 = 0.01;
const K2: f64 = 0.03;

/// Side of the uniform window of QUIVER's and QuDi's tables: scikit-image's default.
const UNIFORM_WINDOW: usize = 7;

/// Side of the Gaussian window of the original paper: 11 x 11, sigma 1.5.
const GAUSSIAN_WINDOW: usize = 11;
const SIGMA: f64 = 1.5;

/// Returns SSIM with a uniform 7 x 7 window, sample covariance, and a border of 3 pixels left out:
/// `skimage.metrics.structural_similarity(truth, estimate, data_range=1)`. Both are clipped to
/// [0, 1]. `None` for frames smaller than the window.
pub fn ssim(estimate: &Frame, truth: &Frame) -> Option<f64> {
    let n = (UNIFORM_WINDOW * UNIFORM_WINDOW) as f64;
    similarity(estimate, truth, &[1.0 / UNIFORM_WINDOW as f64; UNIFORM_WINDOW], n / (n - 1.0))
}

/// Returns SSIM with a Gaussian 11 x 11 window of sigma 1.5 and population covariance, a border of 5 pixels
/// left out: `structural_similarity(..., gaussian_weights=True, sigma=1.5,
/// use_sample_covariance=False, data_range=1)`. `None` for frames smaller than the window.
pub fn gaussian_ssim(estimate: &Frame, truth: &Frame) -> Option<f64> {
    let mut window = [0.0; GAUSSIAN_WINDOW];
    for (i, weight) in window.iter_mut().enumerate() {
        let x = i as f64 - (GAUSSIAN_WINDOW / 2) as f64;
        *weight = (-0.5 * (x / SIGMA).powi(2)).exp();
    }
    let sum: f64 = window.iter().sum();
    similarity(estimate, truth, &window.map(|weight| weight / sum), 1.0)
}

fn similarity(estimate: &Frame, truth: &Frame, window: &[f64], unbias: f64) -> Option<f64> {
    let size = truth.size;
    if size != estimate.size || size.height < window.len() || size.width < window.len() {
        return None;
    }
    let clipped = |frame: &Frame| -> Vec<f64> {
        frame.data.iter().map(|&v| f64::from(v.clamp(0.0, 1.0))).collect()
    };
    let (x, y) = (clipped(estimate), clipped(truth));
    let product = |a: &[f64], b: &[f64]| -> Vec<f64> {
        filter(&a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>(), size, window)
    };
    let (mx, my) = (filter(&x, size, window), filter(&y, size, window));
    let (xx, yy, xy) = (product(&x, &x), product(&y, &y), product(&x, &y));
    let (c1, c2) = (K1 * K1, K2 * K2);
    let total: f64 = (0..mx.len())
        .map(|i| {
            let (mx, my) = (mx[i], my[i]);
            let vx = unbias * (xx[i] - mx * mx);
            let vy = unbias * (yy[i] - my * my);
            let cov = unbias * (xy[i] - mx * my);
            ((2.0 * mx * my + c1) * (2.0 * cov + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
        })
        .sum();
    Some(total / mx.len() as f64)
}

/// Filters rows, then columns, where the window lies inside the image.
fn filter(image: &[f64], size: Size, window: &[f64]) -> Vec<f64> {
    let (n, out) = (window.len(), size.width + 1 - window.len());
    let mut rows = Vec::with_capacity(size.height * out);
    for row in image.chunks_exact(size.width) {
        rows.extend(row.windows(n).map(|w| w.iter().zip(window).map(|(a, b)| a * b).sum::<f64>()));
    }
    let mut columns = vec![0.0; (size.height + 1 - n) * out];
    for (y, sums) in columns.chunks_exact_mut(out).enumerate() {
        for (weight, row) in window.iter().zip(rows[y * out..].chunks_exact(out)) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += weight * value;
            }
        }
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_images_are_fully_similar_and_it_is_symmetric() {
        let size = Size { height: 20, width: 30 };
        let a = Frame::from_fn(size, |x, y| ((x * y) % 7) as f32 / 7.0);
        let b = Frame::from_fn(size, |x, y| ((x + 2 * y) % 5) as f32 / 5.0);
        for metric in [ssim, gaussian_ssim] {
            assert!((metric(&a, &a).unwrap() - 1.0).abs() < 1e-12);
            assert!((metric(&a, &b).unwrap() - metric(&b, &a).unwrap()).abs() < 1e-12);
        }
        let small = Frame::filled(Size { height: 6, width: 30 }, 0.5);
        assert!(ssim(&small, &small).is_none());
    }
}
