//! The colours of a mosaic for a first look: each interpolated from the pixels around that see it.

use crate::colour::{Gains, Rendering};
use qudi_core::Frame;
use qudi_core::colour::{ColourFilter, SensorColour};

/// Share of the pixels of which the brightest colour lies below white.
const BELOW_WHITE: f64 = 0.995;

/// Range of gains that are guessed from means.
const GAIN_RANGE: [f64; 2] = [0.1, 10.0];

/// Interpolates the colours of what the pixels see, with weights that fall linearly over the filter's tile.
pub(super) fn interpolated(seen: &Frame, filter: &ColourFilter) -> [Frame; 3] {
    let size = seen.size;
    // Of filters that do not repeat, all colours are near in practice.
    let reach = filter.tile().map_or(4, |tile| tile.len().isqrt()) as isize;
    let (colours, efficiency) = (filter.colours(), filter.efficiency());
    let value = |x: usize, y: usize, k: usize| {
        let (mut sum, mut weights) = (0.0, 0.0f32);
        for dy in 1 - reach..reach {
            let Some(row) = y.checked_add_signed(dy).filter(|&row| row < size.height) else {
                continue;
            };
            for dx in 1 - reach..reach {
                let Some(column) = x.checked_add_signed(dx).filter(|&x| x < size.width) else {
                    continue;
                };
                let i = row * size.width + column;
                if colours[i] as usize == k {
                    let weight = ((reach - dy.abs()) * (reach - dx.abs())) as f32;
                    sum += weight * seen.data[i];
                    weights += weight;
                }
            }
        }
        sum / weights.max(1.0) / efficiency[k] as f32
    };
    [0, 1, 2].map(|k| Frame::from_fn(size, |x, y| value(x, y, k)))
}

/// Returns a rendering that makes the mean of the picture gray, where the light is unknown.
pub(super) fn gray_world(colours: Option<[Option<f64>; 4]>) -> Rendering {
    let mean = colours.map(|colours| colours.map(|mean| mean.unwrap_or(0.0))).unwrap_or_default();
    let gain = |k: usize| {
        let gain = if mean[k] > 0.0 { mean[1] / mean[k] } else { 1.0 };
        gain.clamp(GAIN_RANGE[0], GAIN_RANGE[1])
    };
    Rendering {
        gains: Gains([gain(0), 1.0, gain(2)]),
        gains_source: "a guess: the mean is taken for gray",
        colour: SensorColour::default(),
    }
}

/// Scales colours so that few of them lie above white, 1; those are clipped.
pub(super) fn with_white_at_highlights(mut planes: [Frame; 3]) -> [Frame; 3] {
    let brightest = |i: usize| planes.iter().map(|plane| plane.data[i]).fold(0.0, f32::max);
    let mut sorted: Vec<f32> = (0..planes[0].data.len()).map(brightest).collect();
    sorted.sort_by(f32::total_cmp);
    let at = (sorted.len().saturating_sub(1) as f64 * BELOW_WHITE) as usize;
    let white = sorted.get(at).copied().unwrap_or(1.0).max(f32::MIN_POSITIVE);
    for value in planes.iter_mut().flat_map(|plane| &mut plane.data) {
        *value = (*value / white).clamp(0.0, 1.0);
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;

    const SIZE: Size = Size { height: 8, width: 12 };

    fn filter(tile: &str) -> ColourFilter {
        let mosaic = tile.parse().unwrap_or_else(|e| panic!("{e}"));
        ColourFilter::tiled(&mosaic, SIZE).unwrap_or_else(|e| panic!("{e}"))
    }

    #[test]
    fn one_colour_everywhere_is_found_without_a_checker() {
        for tile in ["rggb", "gbrg", "wwrwwgwwbwwwwwgw"] {
            let filter = filter(tile).with_efficiency([0.5, 1.0, 0.8, 1.0]);
            let scene = [0.8, 0.4, 0.2].map(|value| Frame::filled(SIZE, value));
            for (plane, truth) in interpolated(&filter.mosaic(&scene), &filter).iter().zip(scene) {
                let near = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-6;
                assert!(plane.data.iter().zip(&truth.data).all(near), "{tile}: {plane:?}");
            }
        }
    }

    #[test]
    fn gains_are_guessed_from_means_in_bounds() {
        let gains = |means| gray_world(means).gains;
        assert_eq!(gains(Some([Some(0.5), Some(1.0), Some(0.0), None])), Gains([2.0, 1.0, 1.0]));
        assert_eq!(gains(Some([Some(1e-9), Some(1.0), Some(2.0), None])), Gains([10.0, 1.0, 0.5]));
        assert_eq!(gains(None), Gains([1.0; 3]));
    }

    #[test]
    fn white_is_common_to_all_colours() {
        let planes = [2.0, 1.0, 0.5].map(|value| Frame::filled(SIZE, value));
        let means = with_white_at_highlights(planes).map(|plane| plane.mean());
        assert_eq!(means, [1.0, 0.5, 0.25]);
    }
}
