//! Detail of an image relative to the truth, in flat and in textured parts.

use crate::frame::Frame;

/// Side of the squares that are ranked by their detail.
pub(super) const SIDE: usize = 16;

/// Energy of the gradients of an image divided by the energy of the truth's: 1 where it has as much detail.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detail {
    /// Ratio in the quarter of the squares with the least detail: above 1 where grain was added.
    pub flat: f64,
    /// Ratio in the quarter with the most detail: below 1 where the image was smoothed.
    pub textured: f64,
}

/// Measures the detail of an image relative to the truth. Returns `None` for frames of different sizes, with
/// fewer than four squares of 16 x 16 pixels, or where the truth is constant in a quarter of them.
pub fn detail(estimate: &Frame, truth: &Frame) -> Option<Detail> {
    if estimate.size != truth.size {
        return None;
    }
    let ratio = |squares: Vec<[usize; 2]>| {
        let of = |frame| squares.iter().map(|&square| energy(frame, square)).sum::<f64>();
        (of(truth) > 0.0).then(|| of(estimate) / of(truth))
    };
    let [flat, textured] = quarters(truth)?.map(ratio);
    Some(Detail { flat: flat?, textured: textured? })
}

/// Returns the upper left corners of the quarter of squares with the least detail and of the quarter with the
/// most; `None` for fewer than four squares.
pub(super) fn quarters(truth: &Frame) -> Option<[Vec<[usize; 2]>; 2]> {
    let mut ranked: Vec<_> =
        squares(truth).into_iter().map(|square| (energy(truth, square), square)).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (quarter, count) = (ranked.len() / 4, ranked.len());
    let corners = |part: &[(f64, [usize; 2])]| part.iter().map(|(_, square)| *square).collect();
    (quarter > 0).then(|| [corners(&ranked[..quarter]), corners(&ranked[count - quarter..])])
}

/// Returns the upper left corners of whole squares.
fn squares(frame: &Frame) -> Vec<[usize; 2]> {
    let rows = (0..frame.size.height / SIDE).map(|row| row * SIDE);
    let columns = 0..frame.size.width / SIDE;
    rows.flat_map(|y| columns.clone().map(move |column| [y, column * SIDE])).collect()
}

/// Sums the squared differences of neighbouring pixels in a square.
fn energy(frame: &Frame, [top, left]: [usize; 2]) -> f64 {
    let width = frame.size.width;
    let value = |y: usize, x: usize| f64::from(frame.data[(top + y) * width + left + x]);
    let mut sum = 0.0;
    for y in 0..SIDE {
        for x in 0..SIDE {
            if x + 1 < SIDE {
                sum += (value(y, x + 1) - value(y, x)).powi(2);
            }
            if y + 1 < SIDE {
                sum += (value(y + 1, x) - value(y, x)).powi(2);
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    /// Creates a scene with a slope on the left and stripes on the right.
    fn scene(grain: f32, contrast: f32) -> Frame {
        let size = Size { height: 32, width: 64 };
        Frame::from_fn(size, |x, y| {
            let grain = if (x + y) % 2 == 0 { grain } else { 0.0 };
            if x < 32 {
                0.01 * x as f32 + grain
            } else {
                0.5 + contrast * ((x / 2 % 2) as f32 - 0.5)
            }
        })
    }

    #[test]
    fn grain_shows_in_flat_parts_and_smoothing_in_texture() {
        let truth = scene(0.0, 0.4);
        let same = detail(&truth, &truth);
        assert_eq!(same, Some(Detail { flat: 1.0, textured: 1.0 }));
        let Some(changed) = detail(&scene(0.02, 0.2), &truth) else { panic!("large enough") };
        assert!(changed.flat > 4.0 && (changed.textured - 0.25).abs() < 1e-3, "{changed:?}");
    }

    #[test]
    fn frames_that_cannot_be_ranked_have_no_detail() {
        let small = Frame::from_fn(Size { height: 16, width: 48 }, |x, _| x as f32);
        assert_eq!(detail(&small, &small), None);
        let flat = Frame::from_fn(Size { height: 64, width: 64 }, |_, _| 0.5);
        assert_eq!(detail(&flat, &flat), None);
    }
}
