//! Restored frames, merged once more: each was denoised for itself and errs in its own way, and what they agree on is
//! steadier. The frames stand for the counts in the robust merge (Hasinoff et al. 2016, section 5), their errors for the
//! noise.

use crate::merge::cubic::cubic_within;
use crate::merge::dft::SIDE;
use crate::merge::wiener::{Member, merge};
use crate::methods::qbp::{Patchwise, at_least, nearest};
use crate::motion::align::finest_grid;
use qudi_core::{Frame, Size};
use rayon::prelude::*;

/// Frames that each is merged with. Those farther away have moved too far to fit.
const NEAREST: usize = 6;

/// Squared difference, in that which errors make, at which a frame counts half.
const TRUST: f32 = 2.0;

/// Least variance of errors: what has none must not divide by zero.
const LEAST: f32 = 1e-8;

/// The restored frames of a window, each merged with its neighbours along `flows`, `[frame]` to all frames. `errors` are the
/// variances of the errors that the frames do not share, pixel by pixel, about; frames of the same size, one for each.
pub(crate) fn steadied(frames: &[Frame], errors: &[Frame], flows: &[&Patchwise]) -> Vec<Frame> {
    let Some(size) = frames.first().map(|frame| frame.size) else { return Vec::new() };
    let large = Size { height: size.height.max(SIDE), width: size.width.max(SIDE) };
    let [frames, errors] = [frames, errors].map(|list| -> Vec<Frame> {
        list.par_iter().map(|frame| at_least(&frame.data, size, large)).collect()
    });
    let grid = finest_grid(large);
    let steady = |reference: usize| {
        let (errors, flows) = (&errors[reference], flows[reference]);
        let others = &nearest(frames.len(), reference, NEAREST + 1)[1..];
        let mut steady = grid.blended(large, size, |i| {
            let corner = grid.corner(i);
            let member = |k: usize, d: [f32; 2]| {
                let at = [corner[0] as f32 + d[0], corner[1] as f32 + d[1]];
                let patch = cubic_within(&frames[k], at, &frames[reference], corner);
                Member { patch, frames: 1.0, noise: 1.0, pilot: None }
            };
            let others = others.iter().map(|&k| member(k, flows[k][i]));
            let members: Vec<_> =
                std::iter::once(member(reference, [0.0; 2])).chain(others).collect();
            let rows = corner[1]..corner[1] + SIDE;
            let rows = rows.map(|y| errors.row(y)[corner[0]..][..SIDE].iter().sum::<f32>());
            let variance = rows.sum::<f32>() / (SIDE * SIDE) as f32;
            merge(&members, variance.max(LEAST), TRUST).0
        });
        // Cubic samples overshoot, but nothing is darker than black.
        steady.data.iter_mut().for_each(|value| *value = value.max(0.0));
        steady
    };
    (0..frames.len()).into_par_iter().map(steady).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::align::align;
    use crate::motion::pyramid::Pyramid;
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    const SIZE: Size = Size { height: 48, width: 64 };

    /// Texture that has moved by `shift` pixels.
    fn texture(shift: f32) -> Frame {
        Frame::from_fn(SIZE, |x, y| {
            let (x, y) = (x as f32 - shift, y as f32 + 0.5 * shift);
            0.5 + 0.2 * (0.5 * x).sin() * (0.4 * y).cos() + 0.15 * (0.23 * x + 0.31 * y).sin()
        })
    }

    /// With errors of deviation `error`, uniform.
    fn wrong(frame: &Frame, error: f32, rng: &mut ChaCha8Rng) -> Frame {
        let half = 3.0f32.sqrt() * error;
        let values = frame.data.iter().map(|v| v + rng.random_range(-half..half));
        Frame { size: frame.size, data: values.collect() }
    }

    /// Along the motion that patches of the frames themselves are matched by.
    fn steadied(frames: &[Frame], errors: &[Frame]) -> Vec<Frame> {
        let large = |frame: &Frame| {
            let Size { height, width } = frame.size;
            let size = Size { height: height.max(SIDE), width: width.max(SIDE) };
            Pyramid::new(&at_least(&frame.data, frame.size, size))
        };
        let pyramids: Vec<Pyramid> = frames.iter().map(large).collect();
        let variance = |error: &Frame| (2.0 * error.mean() as f32).max(LEAST);
        let flows = pyramids.iter().zip(errors).map(|(here, error)| {
            pyramids.iter().map(|there| align(here, there, variance(error))).collect()
        });
        let flows: Vec<Patchwise> = flows.collect();
        super::steadied(frames, errors, &flows.iter().collect::<Vec<_>>())
    }

    fn squared_error(a: &Frame, b: &Frame) -> f32 {
        let squares = a.data.iter().zip(&b.data).map(|(a, b)| (a - b) * (a - b));
        squares.sum::<f32>() / a.data.len() as f32
    }

    #[test]
    fn errors_that_frames_do_not_share_shrink_along_their_motion() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for speed in [0.0, 1.0, 2.3] {
            let truth: Vec<Frame> = (0..7).map(|t| texture(speed * t as f32)).collect();
            let frames: Vec<Frame> = truth.iter().map(|f| wrong(f, 0.04, &mut rng)).collect();
            let errors = vec![Frame::filled(SIZE, 0.04 * 0.04); 7];
            for (t, steady) in steadied(&frames, &errors).iter().enumerate() {
                let share = squared_error(steady, &truth[t]) / squared_error(&frames[t], &truth[t]);
                assert!(share < 0.5, "{share} at speed {speed}");
            }
        }
    }

    #[test]
    fn frames_that_do_not_fit_stay_out() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let other = Frame::from_fn(SIZE, |x, y| ((x * 7 + y * 13) % 11) as f32 / 11.0);
        let mut frames = vec![other; 5];
        frames[2] = wrong(&texture(0.0), 0.02, &mut rng);
        let errors = vec![Frame::filled(SIZE, 0.02 * 0.02); 5];
        let steady = &steadied(&frames, &errors)[2];
        let share = squared_error(steady, &texture(0.0)) / squared_error(&frames[2], &texture(0.0));
        assert!(share < 1.05, "{share}");
    }

    #[test]
    fn small_dark_and_missing_frames_are_no_trouble() {
        assert!(steadied(&[], &[]).is_empty());
        let size = Size { height: 3, width: 5 };
        let black = vec![Frame::filled(size, 0.0); 4];
        assert_eq!(steadied(&black, &black), black);
        assert_eq!(steadied(&black[..1], &black[..1]).len(), 1);
    }
}
