//! The spectrum of an image in octaves, by means of squares (Haar wavelets).

use crate::frame::Frame;

/// Number of octaves: structure of about 2 to 4 pixels, 4 to 8, 8 to 16, 16 to 32, and coarser.
pub const OCTAVES: usize = 5;

/// Returns the energy per pixel of an image in each octave, finest first: the differences between means of
/// squares of 1, 2, 4, 8 and 16 pixels, and the means of the last. They add up to the mean square. Rows and
/// columns past the last whole square of 16 x 16 pixels are left out; `None` if there is none.
pub fn octave_energies(image: &Frame) -> Option<[f64; OCTAVES]> {
    let largest = 1 << (OCTAVES - 1);
    let [mut height, mut width] =
        [image.size.height, image.size.width].map(|side| side / largest * largest);
    if height == 0 || width == 0 {
        return None;
    }
    let rows = (0..height).flat_map(|y| &image.row(y)[..width]);
    let mut means: Vec<f64> = rows.map(|&value| f64::from(value)).collect();
    let energy = |means: &[f64]| means.iter().map(|v| v * v).sum::<f64>() / means.len() as f64;
    let mut energies = [0.0; OCTAVES];
    for octave in &mut energies[..OCTAVES - 1] {
        let before = energy(&means);
        let mean = |i: usize| {
            let at = i / (width / 2) * 2 * width + i % (width / 2) * 2;
            (means[at] + means[at + 1] + means[at + width] + means[at + width + 1]) / 4.0
        };
        means = (0..means.len() / 4).map(mean).collect();
        (height, width) = (height / 2, width / 2);
        // Rounding must not make an energy negative.
        *octave = (before - energy(&means)).max(0.0);
    }
    debug_assert_eq!(means.len(), height * width);
    energies[OCTAVES - 1] = energy(&means);
    Some(energies)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    fn image(f: impl Fn(usize, usize) -> f32) -> Frame {
        Frame::from_fn(Size { height: 37, width: 50 }, f)
    }

    #[test]
    fn stripes_lie_in_their_octave() {
        for (octave, width) in [1usize, 2, 4, 8].into_iter().enumerate() {
            let stripes = image(|x, _| if x / width % 2 == 0 { 0.3 } else { -0.3 });
            let energies = octave_energies(&stripes).unwrap();
            for (at, energy) in energies.into_iter().enumerate() {
                let wanted = if at == octave { 0.09 } else { 0.0 };
                assert!((energy - wanted).abs() < 1e-6, "{width}: {energies:?}");
            }
        }
        let flat = octave_energies(&image(|_, _| 0.5)).unwrap();
        assert!((flat[OCTAVES - 1] - 0.25).abs() < 1e-9 && flat[..4].iter().all(|&e| e < 1e-12));
    }

    #[test]
    fn octaves_add_up_to_the_mean_square() {
        let any = image(|x, y| ((x * 37 + y * 91) % 101) as f32 / 101.0 - 0.3);
        let inside = (0..32).flat_map(|y| &any.row(y)[..48]).map(|&v| f64::from(v).powi(2));
        let mean = inside.sum::<f64>() / (32.0 * 48.0);
        let sum: f64 = octave_energies(&any).unwrap().iter().sum();
        assert!((sum - mean).abs() < 1e-9);
        assert!(octave_energies(&Frame::filled(Size { height: 15, width: 90 }, 1.0)).is_none());
    }
}
