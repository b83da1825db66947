//! The forward model: exact distribution of counts, repeatable counts, unbiased linear estimates.
#![allow(clippy::unwrap_used)]

use qudi_core::Size;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{CountLaw, FullWell, Gain, Sensor};
use qudi_model::diffusion::forward_model::ForwardModel;

const SIZE: Size = Size { height: 128, width: 256 };

fn acquisition(sensor: &str, ppp: f64, frames_summed: u32) -> Acquisition {
    let mut sensor = Sensor::load(sensor).unwrap();
    sensor.frames_summed = frames_summed;
    Acquisition::new(sensor, ppp, 0.45).unwrap().with_seed(1)
}

/// Counts of a flat image of value 0.5 by level, measured at a timestep.
fn histogram(acquisition: &Acquisition, timestep: usize, levels: usize) -> Vec<f64> {
    let model = ForwardModel::new(acquisition, timestep);
    let image = vec![0.5; SIZE.pixels()];
    let planes = model.measure(&image, SIZE, 3, 77).unwrap();
    let mut histogram = vec![0.0; levels];
    for y in planes.y {
        histogram[(y * (levels - 1) as f32).round() as usize] += 1.0;
    }
    histogram
}

fn check(observed: &[f64], probabilities: &[f64]) {
    let n: f64 = observed.iter().sum();
    let (mut chi, mut cells) = (0.0, 0.0);
    for (observed, p) in observed.iter().zip(probabilities) {
        if n * p >= 5.0 {
            chi += (observed - n * p).powi(2) / (n * p);
            cells += 1.0;
        }
    }
    // Five standard deviations of chi-square; the seed is fixed.
    let freedom: f64 = cells - 1.0;
    assert!(
        chi < freedom + 5.0 * (2.0 * freedom).sqrt(),
        "chi-square {chi} of {freedom}: {observed:?}"
    );
}

#[test]
fn counts_follow_the_law_of_the_sensor_under_growing_light() {
    let acquisition = acquisition("qudi-paper", 3.25, 1);
    for (timestep, factor) in [(900, 10f64.powf(0.1)), (500, 10f64.powf(0.5)), (0, 10.0)] {
        let mut sensor = acquisition.sensor.clone();
        let gain = acquisition.gain / factor;
        sensor.gain = Gain::Fixed(gain);
        sensor.full_well = FullWell::new(sensor.full_well.electrons() * factor);
        let detections = 0.8 * 3.25 * factor * 0.5 / 0.45 + 1.6;
        let law = CountLaw::new(&sensor, gain);
        check(&histogram(&acquisition, timestep, 8), &law.probabilities(detections));
    }
}

#[test]
fn sums_of_binary_frames_grow_in_length_at_equal_light() {
    let acquisition = acquisition("swissspad2", 2.0, 7);
    let sensor = Sensor { frames_summed: 22, ..acquisition.sensor.clone() }; // round(7 * sqrt(10))
    let dark = sensor.dark_per_frame().unwrap();
    let photons = 2.0 * 22.0 / 7.0 * 0.5 / 0.45;
    let detections = sensor.quantum_efficiency * photons + dark;
    let law = CountLaw::new(&sensor, 1.0);
    check(&histogram(&acquisition, 500, 23), &law.probabilities(detections));
}

#[test]
fn counts_are_repeatable_by_frame_number() {
    let acquisition = acquisition("qudi-paper", 9.75, 1);
    let image: Vec<f32> = (0..2 * SIZE.pixels()).map(|i| (i % 97) as f32 / 97.0).collect();
    let model = ForwardModel::new(&acquisition, 300);
    let measure = |first, seed| model.measure(&image, SIZE, first, seed).unwrap();
    let all = measure(5, 9);
    assert_eq!(all, measure(5, 9));
    assert_ne!(all.y, measure(5, 10).y);
    // Frames are drawn by their number in the capture: windows that overlap agree.
    let second = model.measure(&image[SIZE.pixels()..], SIZE, 6, 9).unwrap();
    assert_eq!(all.y[SIZE.pixels()..], second.y);
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(all, one.install(|| measure(5, 9)));
}

#[test]
fn linear_estimate_is_unbiased() {
    // Without read noise and with light far from saturation the mean estimate is the image.
    let mut acquisition = acquisition("qudi-paper", 3.25, 1);
    acquisition.sensor.dark = qudi_core::sensor::DarkRate::PerFrame(0.0);
    acquisition.sensor.bits = 8;
    acquisition.gain = 10.0;
    acquisition.sensor.gain = Gain::Fixed(10.0);
    let image = vec![0.45; SIZE.pixels()];
    let planes = ForwardModel::new(&acquisition, 1000).measure(&image, SIZE, 0, 3).unwrap();
    let mean = planes.u.iter().map(|&u| f64::from(u)).sum::<f64>() / planes.u.len() as f64;
    assert!((mean - 0.45).abs() < 0.01, "mean estimate {mean}");
}
