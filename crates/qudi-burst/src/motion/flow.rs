//! Optical flow between two clean frames: for recorded clips, whose true motion is unknown. Patches are
//! aligned in both directions, by the search that aligns bursts.

use super::grid::Grid;
use super::patch_matching::align;
use super::pyramid::Pyramid;
use crate::patch::{padded, padded_size};
use qudi_core::flow::Flow;
use qudi_core::{Frame, Size};

/// Variance of the difference of two pixels: one gray value of 255, since the frames have no noise.
const VARIANCE: f32 = 1.0 / 255.0 / 255.0;

/// Largest error of the way there and back, as a share of both squared lengths and in square pixels (Sundaram
/// et al. 2010).
const MAX_TWO_WAY: (f32, f32) = (0.01, 0.5);

/// Largest change of the frames along the flow, in image units: beyond it the vector is wrong or the surface
/// hidden, and a blurred result would look better than the truth.
const MAX_CHANGE: f32 = 0.1;

/// Estimates the displacement of every pixel of `now` in `next`; `visible` where the way back leads home,
/// stays inside the frame, and finds nearly the same value.
pub fn estimate_flow(now: &Frame, next: &Frame) -> Flow {
    let size = now.size;
    let pyramids =
        [now, next].map(|frame| Pyramid::new(&padded(&frame.data, size, padded_size(size))));
    let grid = Grid::half_overlapping(padded_size(size));
    let dense = |from: usize, to: usize| {
        spread(&grid, &align(&pyramids[from], &pyramids[to], VARIANCE), size)
    };
    let (there, back) = rayon::join(|| dense(0, 1), || dense(1, 0));
    let visible = (0..size.pixels())
        .map(|i| {
            let [dx, dy] = there[i];
            let (x, y) = ((i % size.width) as f32 + dx, (i / size.width) as f32 + dy);
            let inside = x >= 0.0
                && y >= 0.0
                && x <= (size.width - 1) as f32
                && y <= (size.height - 1) as f32;
            if !inside {
                return false;
            }
            let [bx, by] = back[y.round() as usize * size.width + x.round() as usize];
            let (sum, lengths) =
                ((dx + bx).powi(2) + (dy + by).powi(2), dx * dx + dy * dy + bx * bx + by * by);
            let change = next.bilinear(f64::from(x), f64::from(y)) - now.data[i];
            sum <= MAX_TWO_WAY.0 * lengths + MAX_TWO_WAY.1 && change.abs() <= MAX_CHANGE
        })
        .collect();
    let (dx, dy) = there.iter().map(|v| (v[0], v[1])).unzip();
    Flow { size, dx, dy, visible }
}

/// Interpolates the displacements of patches linearly between their centres.
pub(crate) fn spread(grid: &Grid, flow: &[[f32; 2]], size: Size) -> Vec<[f32; 2]> {
    // For every pixel of a row or column, the patch before it and the share of the next one.
    let places = |corners: &[usize], length: usize| -> Vec<(usize, usize, f32)> {
        let place = |at: usize| {
            let corner = at as f32 + 0.5 - 0.5 * grid.side as f32;
            let next = corners.partition_point(|&c| c as f32 <= corner).min(corners.len() - 1);
            let before = next.saturating_sub(1);
            let (low, high) = (corners[before] as f32, corners[next] as f32);
            let share = if high > low { (corner - low) / (high - low) } else { 0.0 };
            (before, next, share.clamp(0.0, 1.0))
        };
        (0..length).map(place).collect()
    };
    let (columns, rows) = (places(&grid.xs, size.width), places(&grid.ys, size.height));
    let at = |row: usize, column: usize| flow[row * grid.xs.len() + column];
    let mix = |a: [f32; 2], b: [f32; 2], share: f32| {
        [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
    };
    let pixel = |&(above, below, down): &(usize, usize, f32)| {
        let line = move |row: usize, &(left, right, across): &(usize, usize, f32)| {
            mix(at(row, left), at(row, right), across)
        };
        columns.iter().map(move |column| mix(line(above, column), line(below, column), down))
    };
    rows.iter().flat_map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::warping_error;
    use qudi_sim::scene::{PROCEDURAL, Procedural};

    /// Returns a texture of several scales, displaced by (`dx`, `dy`).
    fn texture(size: Size, dx: f64, dy: f64) -> Frame {
        Frame::from_fn(size, |x, y| {
            let (x, y) = (x as f64 - dx, y as f64 - dy);
            let waves = (0.31 * x + 0.12 * y).sin()
                + (0.27 * y - 0.07 * x).sin()
                + (0.043 * x + 0.031 * y).sin()
                + (0.05 * y - 0.021 * x + 1.0).sin();
            (0.5 + 0.11 * waves) as f32
        })
    }

    #[test]
    fn known_translations_are_found_to_a_twentieth_of_a_pixel() {
        let size = Size { height: 120, width: 150 };
        let now = texture(size, 0.0, 0.0);
        for [dx, dy] in [[0.0, 0.0], [3.0, -2.0], [0.4, 0.7], [-5.3, 6.6], [10.2, 8.7]] {
            let flow = estimate_flow(&now, &texture(size, dx, dy));
            let inner: Vec<usize> = (0..size.pixels())
                .filter(|i| (24..96).contains(&(i / 150)) && (24..126).contains(&(i % 150)))
                .collect();
            let mut errors: Vec<f64> = inner
                .iter()
                .map(|&i| (f64::from(flow.dx[i]) - dx).hypot(f64::from(flow.dy[i]) - dy))
                .collect();
            errors.sort_by(f64::total_cmp);
            let seen = inner.iter().filter(|&&i| flow.visible[i]).count();
            assert!(errors[errors.len() / 2] < 0.05, "{dx} {dy}: {}", errors[errors.len() / 2]);
            assert!(errors[errors.len() * 95 / 100] < 0.3, "{dx} {dy}");
            assert!(seen * 100 > inner.len() * 95, "{dx} {dy}: {seen} of {}", inner.len());
        }
    }

    #[test]
    fn flow_is_zero_without_texture_and_small_frames_do_not_panic() {
        for (height, width) in [(1, 1), (3, 40), (64, 64), (65, 33)] {
            let flat = Frame::filled(Size { height, width }, 0.4);
            let flow = estimate_flow(&flat, &flat);
            assert!(flow.dx.iter().chain(&flow.dy).all(|&v| v == 0.0));
            assert!(flow.visible.iter().all(|&v| v));
        }
    }

    #[test]
    fn flicker_skips_occluded_and_leaving_pixels() {
        let size = Size { height: 96, width: 128 };
        let now = texture(size, 0.0, 0.0);
        let mut next = now.clone();
        // A black square appears in front.
        for y in 30..60 {
            next.data[y * 128 + 50..y * 128 + 80].fill(0.0);
        }
        let flow = estimate_flow(&now, &next);
        let seen = |ys: std::ops::Range<usize>, xs: std::ops::Range<usize>| {
            let all = ys.len() * xs.len();
            let seen: usize =
                ys.map(|y| xs.clone().filter(|x| flow.visible[y * 128 + x]).count()).sum();
            seen as f64 / all as f64
        };
        assert!(seen(32..58, 52..78) < 0.1, "{}", seen(32..58, 52..78));
        assert!(seen(70..96, 0..128) > 0.95);
        let gone = estimate_flow(&now, &texture(size, 9.0, 0.0));
        assert!((0..96).all(|y| !gone.visible[y * 128 + 127]), "left through the right border");
    }

    /// On scenes whose flow is known, the truth changes along the estimated flow about as little as
    /// along the true one.
    #[test]
    fn truth_hardly_changes_along_its_flow() {
        let size = Size { height: 128, width: 160 };
        for &kind in PROCEDURAL {
            let scene = Procedural { kind, size, seed: 3, speed: 3.0 }.scene();
            let (now, next) = (scene.render(0.0), scene.render(1.0));
            let still = Flow {
                size,
                dx: vec![0.0; size.pixels()],
                dy: vec![0.0; size.pixels()],
                visible: vec![true; size.pixels()],
            };
            let flow = estimate_flow(&now, &next);
            let found = warping_error(&now, &next, &flow).unwrap();
            let unmoved = warping_error(&now, &next, &still).unwrap();
            let seen = flow.visible.iter().filter(|&&v| v).count() as f64 / size.pixels() as f64;
            assert!(found < 0.1 * unmoved, "{kind:?}: {found} {unmoved}");
            assert!(seen > 0.35, "{kind:?}: {seen}");
        }
    }
}
