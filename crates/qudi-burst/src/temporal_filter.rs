//! Temporal filter of restored frames. Frames denoised separately have independent errors, and merging
//! neighbours reduces flicker. It is the robust merge (Hasinoff et al. 2016, section 5) with restored frames
//! in place of counts, and their errors in place of noise.

use crate::merge::cubic::cubic_within;
use crate::merge::wiener::{AlignedPatch, merge};
use crate::motion::grid::Grid;
use crate::patch::{PatchMotion, SIDE, padded, padded_size};
use crate::prepared_burst::nearest;
use qudi_core::Frame;
use rayon::prelude::*;

/// Number of neighbours merged with each frame. Farther frames have moved too far to fit.
const NEIGHBOURS: usize = 6;

/// Constant of the Wiener filter: the squared difference at which a frame gets half its weight, in units of
/// the expected squared difference of errors.
const WIENER_C: f32 = 2.0;

/// Lower bound of the error variance; prevents division by zero.
const MIN_VARIANCE: f32 = 1e-8;

/// Merges each of the restored `frames` of a window with its neighbours. `motions` holds for each frame the
/// motion of its patches to all frames. `error_variances` holds for each frame the approximate variance of
/// the errors that it does not share with other frames, at each pixel.
pub(crate) fn temporal_filter(
    frames: &[Frame],
    error_variances: &[Frame],
    motions: &[&PatchMotion],
) -> Vec<Frame> {
    let Some(size) = frames.first().map(|frame| frame.size) else { return Vec::new() };
    let large = padded_size(size);
    let [frames, errors] = [frames, error_variances].map(|list| -> Vec<Frame> {
        list.par_iter().map(|frame| padded(&frame.data, size, large)).collect()
    });
    let grid = Grid::half_overlapping(large);
    let filtered = |reference: usize| {
        let (errors, motion) = (&errors[reference], motions[reference]);
        let others = &nearest(frames.len(), reference, NEIGHBOURS + 1)[1..];
        let mut filtered = grid.blended(large, size, |i| {
            let corner = grid.corner(i);
            let aligned = |k: usize, d: [f32; 2]| {
                let at = [corner[0] as f32 + d[0], corner[1] as f32 + d[1]];
                let patch = cubic_within(&frames[k], at, &frames[reference], corner);
                AlignedPatch { patch, frames: 1.0, noise: 1.0 }
            };
            let others = others.iter().map(|&k| aligned(k, motion[k][i]));
            let patches: Vec<_> =
                std::iter::once(aligned(reference, [0.0; 2])).chain(others).collect();
            let rows = corner[1]..corner[1] + SIDE;
            let rows = rows.map(|y| errors.row(y)[corner[0]..][..SIDE].iter().sum::<f32>());
            let variance = rows.sum::<f32>() / (SIDE * SIDE) as f32;
            merge(&patches, variance.max(MIN_VARIANCE), WIENER_C).0
        });
        // Cubic samples overshoot, but nothing is darker than black.
        filtered.data.iter_mut().for_each(|value| *value = value.max(0.0));
        filtered
    };
    (0..frames.len()).into_par_iter().map(filtered).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::patch_matching::align;
    use crate::motion::pyramid::Pyramid;
    use qudi_core::Size;
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    const SIZE: Size = Size { height: 48, width: 64 };

    /// Returns a texture that has moved by `shift` pixels.
    fn texture(shift: f32) -> Frame {
        Frame::from_fn(SIZE, |x, y| {
            let (x, y) = (x as f32 - shift, y as f32 + 0.5 * shift);
            0.5 + 0.2 * (0.5 * x).sin() * (0.4 * y).cos() + 0.15 * (0.23 * x + 0.31 * y).sin()
        })
    }

    /// Adds uniform errors of the sigma `error`.
    fn with_errors(frame: &Frame, error: f32, rng: &mut ChaCha8Rng) -> Frame {
        let half = 3.0f32.sqrt() * error;
        let values = frame.data.iter().map(|v| v + rng.random_range(-half..half));
        Frame { size: frame.size, data: values.collect() }
    }

    /// Applies the filter along the motion found by matching patches of the frames themselves.
    fn filtered(frames: &[Frame], errors: &[Frame]) -> Vec<Frame> {
        let large =
            |frame: &Frame| Pyramid::new(&padded(&frame.data, frame.size, padded_size(frame.size)));
        let pyramids: Vec<Pyramid> = frames.iter().map(large).collect();
        let variance = |error: &Frame| (2.0 * error.mean() as f32).max(MIN_VARIANCE);
        let flows = pyramids.iter().zip(errors).map(|(here, error)| {
            pyramids.iter().map(|there| align(here, there, variance(error))).collect()
        });
        let flows: Vec<PatchMotion> = flows.collect();
        temporal_filter(frames, errors, &flows.iter().collect::<Vec<_>>())
    }

    fn squared_error(a: &Frame, b: &Frame) -> f32 {
        let squares = a.data.iter().zip(&b.data).map(|(a, b)| (a - b) * (a - b));
        squares.sum::<f32>() / a.data.len() as f32
    }

    #[test]
    fn reduces_errors_that_frames_do_not_share() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for speed in [0.0, 1.0, 2.3] {
            let truth: Vec<Frame> = (0..7).map(|t| texture(speed * t as f32)).collect();
            let frames: Vec<Frame> = truth.iter().map(|f| with_errors(f, 0.04, &mut rng)).collect();
            let errors = vec![Frame::filled(SIZE, 0.04 * 0.04); 7];
            for (t, smooth) in filtered(&frames, &errors).iter().enumerate() {
                let share = squared_error(smooth, &truth[t]) / squared_error(&frames[t], &truth[t]);
                assert!(share < 0.5, "{share} at speed {speed}");
            }
        }
    }

    #[test]
    fn leaves_out_frames_that_do_not_fit() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let other = Frame::from_fn(SIZE, |x, y| ((x * 7 + y * 13) % 11) as f32 / 11.0);
        let mut frames = vec![other; 5];
        frames[2] = with_errors(&texture(0.0), 0.02, &mut rng);
        let errors = vec![Frame::filled(SIZE, 0.02 * 0.02); 5];
        let smooth = &filtered(&frames, &errors)[2];
        let share = squared_error(smooth, &texture(0.0)) / squared_error(&frames[2], &texture(0.0));
        assert!(share < 1.05, "{share}");
    }

    #[test]
    fn filters_small_and_dark_frames_and_none() {
        assert!(filtered(&[], &[]).is_empty());
        let size = Size { height: 3, width: 5 };
        let black = vec![Frame::filled(size, 0.0); 4];
        assert_eq!(filtered(&black, &black), black);
        assert_eq!(filtered(&black[..1], &black[..1]).len(), 1);
    }
}
