//! Peak signal-to-noise ratio in dB, for values in [0, 1].

use crate::frame::Frame;

/// Largest PSNR in dB: of equal frames, and of frames that differ by less than a step of 16 bits.
pub const MAX_PSNR: f64 = 100.0;

/// Returns the PSNR of `estimate` against `truth`, both clipped to [0, 1], at most [`MAX_PSNR`].
pub fn psnr(estimate: &Frame, truth: &Frame) -> f64 {
    scaled_psnr(estimate, truth, 1.0)
}

/// Returns the PSNR after the best global gain: photon counts fix an image only up to its exposure.
pub fn gain_aligned_psnr(estimate: &Frame, truth: &Frame) -> f64 {
    scaled_psnr(estimate, truth, best_gain(estimate, truth))
}

/// Returns the factor on `estimate` with the least squared error; 0 for a negative of the truth, which no
/// exposure makes, and 1 where one of them is black.
pub fn best_gain(estimate: &Frame, truth: &Frame) -> f64 {
    let (mut cross, mut square, mut light) = (0.0, 0.0, 0.0);
    for (&e, &t) in estimate.data.iter().zip(&truth.data) {
        cross += f64::from(e) * f64::from(t);
        square += f64::from(e) * f64::from(e);
        light += f64::from(t.abs());
    }
    if square > 0.0 && light > 0.0 { (cross / square).max(0.0) } else { 1.0 }
}

fn scaled_psnr(estimate: &Frame, truth: &Frame, gain: f64) -> f64 {
    let error = estimate.data.iter().zip(&truth.data).map(|(&e, &t)| {
        let difference = (f64::from(e) * gain).clamp(0.0, 1.0) - f64::from(t).clamp(0.0, 1.0);
        difference * difference
    });
    let mean = error.sum::<f64>() / estimate.data.len() as f64;
    (-10.0 * mean.log10()).min(MAX_PSNR)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    #[test]
    fn psnr_of_known_error_is_exact() {
        let size = Size { height: 4, width: 5 };
        let truth = Frame::filled(size, 0.5);
        assert!((psnr(&Frame::filled(size, 0.6), &truth) - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&truth, &truth), MAX_PSNR);
    }

    #[test]
    fn gain_alignment_forgives_exposure_only() {
        let size = Size { height: 8, width: 8 };
        let truth = Frame::from_fn(size, |x, y| 0.1 + 0.01 * (x * y) as f32);
        let mut darker = truth.clone();
        darker.data.iter_mut().for_each(|v| *v *= 0.4);
        assert!((best_gain(&darker, &truth) - 2.5).abs() < 1e-6);
        assert_eq!(gain_aligned_psnr(&darker, &truth), MAX_PSNR);
        assert!(psnr(&darker, &truth) < 20.0);
        // A negative is no exposure of the truth, and a black truth fixes none.
        let mut negative = truth.clone();
        negative.data.iter_mut().for_each(|v| *v = -*v);
        assert_eq!(best_gain(&negative, &truth), 0.0);
        let black = Frame::filled(size, 0.0);
        assert_eq!(best_gain(&truth, &black), 1.0);
        assert_eq!(gain_aligned_psnr(&truth, &black), psnr(&truth, &black));
    }
}
