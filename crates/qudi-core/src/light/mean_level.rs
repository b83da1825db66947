//! Default mean level of a restored picture: the mean level of usual scenes, or less for scenes with
//! highlights.

use crate::error::Result;
use crate::frame::Size;
use crate::light::USUAL_MEAN_LEVEL;
use crate::restorer::{Acquisition, BurstView};
use crate::sensor::{CountLaw, Response};
use crate::windows::LONGEST_HALF;

/// Side in pixels of the squares over which photons are counted, since single pixels are mostly noise.
const SIDE: usize = 8;

/// Inverse share of a square's brightest and of its darkest pixels that are left out: they may be hot or
/// dead.
const TRIM_DIVISOR: usize = 16;

/// Inverse share of the squares that may be brighter than white.
const CLIPPED_DIVISOR: usize = 1000;

/// Image value given to the brightest remaining square, below 1 since details smaller than a square are
/// brighter.
const HIGHLIGHT_LEVEL: f64 = 0.75;

/// Estimates the image value that should receive `acquisition.ppp` photons: [`USUAL_MEAN_LEVEL`], or less
/// where parts of the scene would be brighter than white.
///
/// `acquisition.mean_level` is not used. `read` is asked for the first, the middle and the last 11 of
/// `frames` frames, in this order.
///
/// # Errors
/// [`Error`](crate::Error) if the sensor's dark rate is unknown, and what `read` returns.
pub fn fitting_mean_level(
    size: Size,
    frames: u64,
    acquisition: &Acquisition,
    mut read: impl FnMut(u64) -> Result<Vec<u16>>,
) -> Result<f64> {
    let length = frames.min(2 * LONGEST_HALF as u64 + 1);
    let mut starts = vec![0, (frames - length) / 2, frames - length];
    starts.dedup();
    let mut mean_level = USUAL_MEAN_LEVEL;
    for start in starts {
        let frames = (start..start + length).map(&mut read).collect::<Result<Vec<_>>>()?;
        let bright = brightest(BurstView { size, frames: &frames }, acquisition)?;
        mean_level =
            mean_level.min(HIGHLIGHT_LEVEL * acquisition.ppp / bright.max(f64::MIN_POSITIVE));
    }
    Ok(mean_level)
}

/// Returns the photons per pixel and frame that a thousandth of the squares exceed.
fn brightest(burst: BurstView<'_>, acquisition: &Acquisition) -> Result<f64> {
    let typical = acquisition.sensor.dark_per_frame()?;
    let size = burst.size;
    let mut sums = vec![0u32; size.pixels()];
    for frame in burst.frames {
        sums.iter_mut().zip(frame).for_each(|(sum, &count)| *sum += u32::from(count));
    }
    let mut squares = Vec::new();
    for top in (0..size.height).step_by(SIDE) {
        for left in (0..size.width).step_by(SIDE) {
            let rows = top..(top + SIDE).min(size.height);
            let columns = left..(left + SIDE).min(size.width);
            let places = rows.flat_map(|y| columns.clone().map(move |x| y * size.width + x));
            let mut pixels: Vec<(u32, f64)> =
                places.map(|i| (sums[i], acquisition.dark_of(i, typical))).collect();
            pixels.sort_unstable_by_key(|&(sum, _)| sum);
            let trimmed = pixels.len() / TRIM_DIVISOR;
            let pixels = &pixels[trimmed..pixels.len() - trimmed];
            let dark = pixels.iter().map(|(_, dark)| dark).sum::<f64>() / pixels.len() as f64;
            let total: f64 = pixels.iter().map(|&(sum, _)| f64::from(sum)).sum();
            let samples = (pixels.len() * burst.frames.len()) as u32;
            let flux = acquisition.sensor.estimate_flux(total, samples, acquisition.gain, dark);
            squares.push((flux, total / f64::from(samples), dark));
        }
    }
    let place = squares.len() - 1 - squares.len() / CLIPPED_DIVISOR;
    let (_, &mut (flux, mean, dark), _) =
        squares.select_nth_unstable_by(place, |a, b| f64::total_cmp(&a.0, &b.0));
    if acquisition.sensor.response == Response::Binary {
        return Ok(flux);
    }
    // Full scale cuts off bright counts. The law corrects that, but takes seconds for all squares of deep
    // counts.
    let law = CountLaw::new(&acquisition.sensor, acquisition.gain);
    Ok((law.detections_for_mean(mean) - dark) / acquisition.sensor.quantum_efficiency)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::Camera;
    use crate::frame::Frame;
    use crate::light::Light;
    use crate::sensor::Sensor;

    const SIZE: Size = Size { height: 64, width: 80 };

    /// Estimates the exposure of a scene whose mean gets `ppp` photons, with every `hot`-th pixel at full
    /// scale.
    fn estimated(scene: &Frame, sensor: &str, ppp: f64, hot: usize) -> f64 {
        let sensor = Sensor::load(sensor).unwrap();
        let light = Light { ppp, mean_level: scene.mean() };
        let mut camera = Camera::new(&sensor, SIZE, light, 5).unwrap();
        let acquisition = Acquisition::new(sensor, ppp, f64::NAN).unwrap();
        fitting_mean_level(SIZE, 30, &acquisition, |t| {
            let mut counts = camera.expose(t, &[scene])?;
            counts
                .iter_mut()
                .step_by(hot)
                .for_each(|count| *count = acquisition.sensor.max_count());
            Ok(counts)
        })
        .unwrap()
    }

    /// Creates a scene with a fifth of it three times as bright as the rest.
    fn lamp(brightest: f32) -> Frame {
        Frame::from_fn(SIZE, |x, _| if x < 16 { brightest } else { brightest / 3.0 })
    }

    #[test]
    fn chooses_the_usual_exposure_where_the_scene_fits() {
        let even = Frame::from_fn(SIZE, |x, _| 0.5 + 0.004 * x as f32);
        assert_eq!(estimated(&even, "qudi-paper", 3.25, usize::MAX), USUAL_MEAN_LEVEL);
        assert_eq!(estimated(&even, "spad512s", 0.3, usize::MAX), USUAL_MEAN_LEVEL);
        // Hot pixels do not belong to the scene.
        assert_eq!(estimated(&even, "spad512s", 0.05, 131), USUAL_MEAN_LEVEL);
    }

    #[test]
    fn keeps_the_brightest_squares_below_white() {
        for (sensor, ppp) in [("qudi-paper", 2.0), ("qudi-paper", 26.0), ("spad512s", 2.0)] {
            // The scene's mean is 0.467 where its brightest is 1; the exposure does not depend on the scale,
            // and is 0.35 but for the noise of the brightest square.
            for brightest in [1.0, 0.2] {
                let mean_level = estimated(&lamp(brightest), sensor, ppp, usize::MAX);
                assert!(
                    (0.29..0.37).contains(&mean_level),
                    "{sensor} {ppp} {brightest}: {mean_level}"
                );
            }
        }
    }
}
