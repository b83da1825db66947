//! Variances and exact inverses of the transforms, compared with SciPy (`tests/golden/generate/baselines.py`)
//! and with simulated counts.
#![allow(clippy::unwrap_used)]

use qudi_burst::{Transform, VarianceStabilizer};
use qudi_core::sensor::{Gain, Sensor};
use qudi_core::{Camera, Frame, Light, Size};
use std::path::Path;

fn golden(key: &str) -> Vec<serde_json::Value> {
    let file = "../../tests/golden/baselines/figures.json";
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap();
    let figures: serde_json::Value = serde_json::from_str(&text).unwrap();
    figures[key].as_array().unwrap().clone()
}

#[test]
fn binomial_transform_matches_scipy() {
    for figure in golden("binomial") {
        let value = |key: &str| figure[key].as_f64().unwrap();
        let mut sensor = Sensor::load("spad512s").unwrap();
        sensor.frames_summed = value("trials") as u32;
        let stabilizer = VarianceStabilizer::new(Transform::Anscombe, &sensor, 1.0, 1);
        let detections = -value("trials") * (-value("p")).ln_1p();
        let (z, variance) = (value("mean"), value("variance"));
        assert!((stabilizer.invert(z) / detections - 1.0).abs() < 1e-3, "{figure}");
        assert!((stabilizer.sigma(z).powi(2) / variance - 1.0).abs() < 5e-3, "{figure}");
        // The variance of sums of 77 is 1 everywhere; the variance of sums of 7 is 1 only in the middle.
        let (trials, p) = (value("trials"), value("p"));
        if trials > 70.0 || (p > 0.2 && p < 0.8) {
            assert!((variance - 1.0).abs() < 0.03, "{figure}");
        } else {
            assert!(variance < 0.9, "{figure}");
        }
    }
}

#[test]
fn generalized_transform_matches_scipy() {
    for figure in golden("generalized") {
        let value = |key: &str| figure[key].as_f64().unwrap();
        let mut sensor = Sensor::load("ideal").unwrap();
        sensor.bits = 12;
        sensor.gain = Gain::Unit;
        sensor.read_noise = value("read_noise");
        let closed = VarianceStabilizer::new(Transform::Anscombe, &sensor, 1.0, 1);
        sensor.bits = 6;
        let exact = VarianceStabilizer::new(Transform::Anscombe, &sensor, 1.0, 1);
        let (z, electrons) = (value("mean"), value("electrons"));
        assert!((exact.invert(z) / electrons - 1.0).abs() < 2e-3, "{figure}: {}", exact.invert(z));
        assert!((exact.sigma(z).powi(2) / value("variance") - 1.0).abs() < 0.01, "{figure}");
        // The closed form is asymptotic and ignores the clipping at zero counts.
        if electrons > 4.0 {
            assert!((closed.invert(z) / electrons - 1.0).abs() < 0.03, "{}", closed.invert(z));
        }
    }
}

/// Checks that simulated counts, summed, transformed, averaged and inverted, return the light, up to nearly
/// full saturation.
#[test]
fn inverses_are_unbiased_on_simulated_counts() {
    let size = Size { height: 128, width: 128 };
    for (name, ppp, summed) in [
        ("qudi-paper", 3.25, 1),
        ("qudi-paper", 26.0, 1),
        ("spad512s", 3.0, 7),
        ("qis4-gj", 9.75, 1),
    ] {
        let mut sensor = Sensor::load(name).unwrap();
        sensor.frames_summed = summed;
        let dark = sensor.dark_per_frame().unwrap();
        for frames in [1u32, 5] {
            for image in [0.1, 0.45, 0.8] {
                let light = Light { ppp, mean_level: 0.45 };
                let mut camera = Camera::new(&sensor, size, light, 11).unwrap();
                let scene = Frame::filled(size, image);
                let mut sums = vec![0.0; size.pixels()];
                for t in 0..frames {
                    let counts = camera.expose(u64::from(t), &[&scene]).unwrap();
                    sums.iter_mut().zip(counts).for_each(|(s, c)| *s += f64::from(c));
                }
                let detections = sensor.quantum_efficiency * ppp * f64::from(image) / 0.45 + dark;
                for transform in [Transform::Identity, Transform::Anscombe, Transform::Integral] {
                    let stabilizer =
                        VarianceStabilizer::new(transform, &sensor, camera.gain(), frames);
                    let z: Vec<f64> = sums.iter().map(|&sum| stabilizer.transform(sum)).collect();
                    let mean = z.iter().sum::<f64>() / z.len() as f64;
                    let variance =
                        z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / z.len() as f64;
                    let found = stabilizer.invert(mean);
                    // Four standard errors of the mean, through the slope of the inverse.
                    let step = 4.0 * (variance / z.len() as f64).sqrt();
                    let slope = stabilizer.invert(mean + step) - found;
                    let case =
                        format!("{name} {ppp} PPP, {frames} frames of {image}: {transform:?}");
                    assert!(
                        (found - detections).abs() < slope.abs() + 2e-3 * detections,
                        "{case}: {found}, truth {detections}"
                    );
                    let expected = stabilizer.sigma(mean).powi(2);
                    // The inverse of deep samples is asymptotic, and too large for a few electrons.
                    assert!(
                        (variance / expected - 1.0).abs() < 0.06 || name == "qis4-gj",
                        "{case}: {variance} {expected}"
                    );
                }
            }
        }
    }
}

/// Checks that the integral keeps unit variance near saturation, where Anscombe's transform does not.
#[test]
fn integral_transform_follows_counts_into_saturation() {
    let sensor = Sensor::load("qudi-paper").unwrap();
    let gain = sensor.gain_at(3.25).unwrap();
    let of = |transform| VarianceStabilizer::new(transform, &sensor, gain, 1);
    let (anscombe, integral) = (of(Transform::Anscombe), of(Transform::Integral));
    // Mean count of 6 out of 7.
    let deviation = |s: &VarianceStabilizer| s.sigma(s.transform(6.0));
    assert!(deviation(&anscombe) < 0.75, "{}", deviation(&anscombe));
    assert!((deviation(&integral) - 1.0).abs() < 0.2, "{}", deviation(&integral));
}

#[test]
fn light_range_ends_are_finite_and_ordered() {
    for name in ["qudi-paper", "ideal", "swissspad2", "qis4-gj"] {
        let sensor = Sensor::load(name).unwrap();
        for transform in [Transform::Identity, Transform::Anscombe, Transform::Integral] {
            let stabilizer = VarianceStabilizer::new(transform, &sensor, 1.0, 3);
            let (low, high) = (
                stabilizer.invert(stabilizer.transform(0.0)),
                stabilizer.invert(stabilizer.transform(3.0 * f64::from(sensor.max_count()))),
            );
            assert!(low.is_finite() && high.is_finite() && low >= 0.0 && high > low, "{name}");
            assert!(stabilizer.invert(1e9).is_finite() && stabilizer.invert(-1e9) >= 0.0);
        }
    }
}
