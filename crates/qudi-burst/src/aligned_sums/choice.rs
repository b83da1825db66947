//! Choice of the number of frames per aligned sum by cross-validation: the number that best predicts held-out
//! frames.

use super::AlignedSums;
use super::motion::BlockMotion;
use crate::methods::{PostFilter, Qbp};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::{Frame, Result};
use std::ops::Range;

/// Maximum number of places in a burst where frames are held out and predicted.
const MAX_PREDICTIONS: usize = 12;

/// Chooses the number of frames per sum, among `counts`, with the least prediction error of [`AlignedSums`]
/// of quanta burst photography. Motion is found between sums of `block` frames. At several places in
/// `samples`, `held` frames are held out and predicted from the others. The noise of held-out frames adds the
/// same error to all predictions. Among numbers whose errors are equal within one standard error, the largest
/// is chosen.
///
/// # Errors
/// [`Error`](qudi_core::Error) if sums do not fit into 16 bits, or the dark rate of the sensor is unknown.
pub fn choose_count(
    samples: &[BurstView<'_>],
    acquisition: &Acquisition,
    block: usize,
    held: usize,
    counts: &[usize],
) -> Result<Option<usize>> {
    let mut errors: Vec<Vec<f64>> = Vec::new();
    for &sample in samples {
        let motion = BlockMotion::find(sample, acquisition, block)?;
        let frames = sample.frames.len();
        let places = MAX_PREDICTIONS.div_ceil(samples.len()).min(frames / (8 * held));
        let back: Vec<Range<usize>> = (0..places)
            .map(|place| (place + 1) * frames / (places + 1))
            .map(|middle| middle - held / 2..middle + held.div_ceil(2))
            .collect();
        let is_kept = |frame: &usize| !back.iter().any(|back| back.contains(frame));
        let kept: Vec<usize> = (0..frames).filter(is_kept).collect();
        for back in &back {
            let middle = back.start + held / 2;
            let shown = motion.sum(middle, back.clone());
            let error = |&count: &usize| {
                let (sums, at) = motion.sums_of(&kept, middle, count);
                let of_sums = AlignedSums::acquisition(acquisition, count)?;
                let view = BurstView { size: sample.size, frames: &sums };
                let mut qbp = Qbp::new(PostFilter::Bm3d);
                let image = qbp.restore_frames(view, &of_sums, &[at])?.frames.swap_remove(0);
                squared_error(&image, &shown, acquisition, held as f64)
            };
            errors.push(counts.iter().map(error).collect::<Result<_>>()?);
        }
    }
    Ok(largest_of_the_best(&errors).map(|best| counts[best]))
}

/// Returns the last choice whose error exceeds the least one by no more than the standard error of their
/// difference. `errors` is `[place][choice]`.
fn largest_of_the_best(errors: &[Vec<f64>]) -> Option<usize> {
    let n = errors.len() as f64;
    let total = |choice: usize| errors.iter().map(|errors| errors[choice]).sum::<f64>();
    let choices = 0..errors.first()?.len();
    let best = choices.clone().min_by(|&a, &b| total(a).total_cmp(&total(b)))?;
    let as_good = |&choice: &usize| {
        let differences = errors.iter().map(|errors| errors[choice] - errors[best]);
        let mean = differences.clone().sum::<f64>() / n;
        let variance = differences.map(|d| (d - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        mean <= (variance / n).sqrt()
    };
    choices.rev().find(as_good)
}

/// Returns the squared error between the predicted and the actual sum of `frames` frames.
fn squared_error(
    image: &Frame,
    shown: &[u16],
    acquisition: &Acquisition,
    frames: f64,
) -> Result<f64> {
    let sensor = &acquisition.sensor;
    let trials = f64::from(sensor.max_count());
    let dark = sensor.dark_per_frame()?;
    let units = sensor.quantum_efficiency * acquisition.photons_per_unit();
    let error = |(&value, &count): (&f32, &u16)| {
        let detections = units * f64::from(value.max(0.0)) + dark;
        let mean = -frames * trials * (-detections / trials).exp_m1();
        (mean - f64::from(count)).powi(2)
    };
    Ok(image.data.iter().zip(shown).map(error).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light, Size};

    fn chosen(place: impl Fn(f32) -> f32) -> usize {
        let size = Size { height: 96, width: 128 };
        let sensor = Sensor::load("swissspad2").unwrap();
        let light = Light { ppp: 4.0, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, size, light, 5).unwrap();
        let frames: Vec<Vec<u16>> = (0..220u8)
            .map(|t| {
                let shift = place(f32::from(t));
                let scene = Frame::from_fn(size, |x, y| {
                    let (x, y) = (x as f32 - shift, y as f32);
                    0.45 + 0.15 * (0.5 * x + 0.2 * y).sin() + 0.15 * (0.35 * y - 0.3 * x).sin()
                });
                camera.expose(u64::from(t), &[&scene]).unwrap()
            })
            .collect();
        let acquisition = Acquisition::new(sensor, light.ppp, 0.45).unwrap();
        let sample = BurstView { size, frames: &frames };
        choose_count(&[sample], &acquisition, 10, 1, &[2, 6, 20]).unwrap().unwrap()
    }

    #[test]
    fn even_motion_is_followed_for_long_and_shaking_is_not() {
        assert_eq!(chosen(|t| 0.1 * t), 20);
        assert!(chosen(|t| 6.0 * (0.2 * t).sin()) < 20);
    }
}
