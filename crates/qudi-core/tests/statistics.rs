//! The camera against closed forms: every sensor kind, every light level, every defect.
//! Seeds are fixed, so these tests either always pass or always fail.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use qudi_core::sensor::{CountLaw, DarkRate, FullWell, Gain, Sensor};
use qudi_core::{Camera, Frame, Light, Size};

const SIZE: Size = Size { height: 512, width: 512 };

/// Exposes `frames` flat frames with `detections` expected per pixel (dark ones included).
fn expose_flat(sensor: &Sensor, detections: f64, frames: u64) -> Vec<Vec<u16>> {
    let dark = sensor.dark_per_frame().unwrap();
    let ppp = (detections - dark) / sensor.quantum_efficiency;
    let light = Light { ppp: ppp.max(0.0), mean_level: 0.5 };
    let mut camera = Camera::new(sensor, SIZE, light, 20).unwrap();
    let scene = Frame::filled(SIZE, 0.5);
    (0..frames).map(|t| camera.expose(t, &[&scene]).unwrap()).collect()
}

/// Returns how many standard deviations a chi-square statistic lies from its mean (Wilson, Hilferty
/// 1931), with cells below 10 expected counts pooled.
fn chi_square_z(observed: &[u64], probabilities: &[f64]) -> f64 {
    let n = observed.iter().sum::<u64>() as f64;
    let (mut chi, mut cells) = (0.0, 0);
    let (mut pooled_seen, mut pooled_expected) = (0.0, 0.0);
    for (&seen, &p) in observed.iter().zip(probabilities) {
        pooled_seen += seen as f64;
        pooled_expected += n * p;
        if pooled_expected >= 10.0 {
            chi += (pooled_seen - pooled_expected).powi(2) / pooled_expected;
            cells += 1;
            (pooled_seen, pooled_expected) = (0.0, 0.0);
        }
    }
    if pooled_seen + pooled_expected > 0.0 {
        // What is left over is too rare for a cell of its own: bound it alone.
        let spread = pooled_expected.max(1.0).sqrt();
        assert!(
            (pooled_seen - pooled_expected).abs() < 6.0 * spread,
            "{pooled_seen} rare counts, {pooled_expected} expected"
        );
    }
    if cells < 2 {
        return 0.0;
    }
    let k = f64::from(cells - 1);
    ((chi / k).cbrt() - (1.0 - 2.0 / (9.0 * k))) / (2.0 / (9.0 * k)).sqrt()
}

fn histogram(frames: &[Vec<u16>], max_count: u16) -> Vec<u64> {
    let mut histogram = vec![0; usize::from(max_count) + 1];
    frames.iter().flatten().for_each(|&c| histogram[usize::from(c)] += 1);
    histogram
}

fn moments(frames: &[Vec<u16>]) -> (f64, f64) {
    let n = frames.iter().map(Vec::len).sum::<usize>() as f64;
    let values = || frames.iter().flatten().map(|&c| f64::from(c));
    let mean = values().sum::<f64>() / n;
    (mean, values().map(|v| (v - mean).powi(2)).sum::<f64>() / n)
}

fn linear(bits: u8, gain: f64, read_noise: f64, full_well: f64) -> Sensor {
    let mut sensor = Sensor::load("ideal").unwrap();
    sensor.bits = bits;
    sensor.gain = Gain::Fixed(gain);
    sensor.read_noise = read_noise;
    sensor.full_well = FullWell::new(full_well);
    sensor
}

fn binary(frames_summed: u32) -> Sensor {
    let mut sensor = Sensor::load("swissspad2").unwrap();
    sensor.quantum_efficiency = 1.0;
    sensor.dark = DarkRate::PerFrame(0.0);
    sensor.frames_summed = frames_summed;
    sensor
}

#[test]
fn counts_follow_the_exact_law_at_every_light_level_and_depth() {
    for lambda in [0.0, 1e-9, 0.01, 0.1, 1.0, 4.2, 11.9, 12.1, 50.0, 210.0] {
        for bits in [1, 3, 8, 12] {
            for (gain, read_noise, full_well) in [
                (1.0, 0.0, f64::INFINITY),
                (1.0, 0.2, 200.0),
                (0.37, 0.35, f64::INFINITY),
                (0.5, 0.0, f64::INFINITY),
            ] {
                let sensor = linear(bits, gain, read_noise, full_well);
                let law = CountLaw::new(&sensor, gain);
                let seen = histogram(&expose_flat(&sensor, lambda, 4), sensor.max_count());
                let z = chi_square_z(&seen, &law.probabilities(lambda));
                println!(
                    "lambda {lambda:>6} bits {bits:>2} gain {gain:.2} noise {read_noise:.2}: z = {z:+.2}"
                );
                assert!(
                    z < 4.5,
                    "lambda {lambda}, {bits} bits, gain {gain}, noise {read_noise}: z = {z}"
                );
            }
        }
    }
}

#[test]
fn flat_scenes_have_the_moments_of_the_published_simulator() {
    // Mean and sigma of y/7 from an independent NumPy simulation of the same equations,
    // tests/golden/generate/sensor_moments.py.
    for (ppp, mean, sigma) in
        [(3.25, 0.607, 0.273), (9.75, 0.484, 0.163), (19.5, 0.441, 0.114), (26.0, 0.431, 0.100)]
    {
        let sensor = Sensor::load("qudi-paper").unwrap();
        let detections = 0.8 * ppp + 1.6;
        let (m, v) = moments(&expose_flat(&sensor, detections, 8));
        println!("ppp {ppp:>5}: mean {:.4} sigma {:.4}", m / 7.0, v.sqrt() / 7.0);
        assert!((m / 7.0 - mean).abs() < 1e-3, "{ppp}: mean {}", m / 7.0);
        assert!((v.sqrt() / 7.0 - sigma).abs() < 1e-3, "{ppp}: sigma {}", v.sqrt() / 7.0);
    }
}

#[test]
fn summed_binary_frames_are_binomial() {
    for n in [1, 7, 15, 77, 255] {
        for lambda in [0.0, 0.05, 0.464, 1.2, 8.43, 60.0] {
            let sensor = binary(n);
            let seen = histogram(&expose_flat(&sensor, lambda, 2), sensor.max_count());
            let p = -(-lambda / f64::from(n)).exp_m1();
            // Binomial probabilities by their recurrence, from the mode's side that does not vanish.
            let mut pmf = vec![0.0; n as usize + 1];
            let mut term = (1.0 - p).powi(n as i32);
            for (k, cell) in pmf.iter_mut().enumerate() {
                *cell = term;
                term *= f64::from(n - k as u32) / (k as f64 + 1.0) * p / (1.0 - p);
            }
            let z = chi_square_z(&seen, &pmf);
            println!("n {n:>3} detections {lambda:>5}: z = {z:+.2}");
            assert!(z < 4.5, "n {n} at {lambda}: z = {z}");
        }
    }
}

/// Instants of one exposure that differ, so that each binary frame sees its own light.
#[test]
fn motion_inside_an_exposure_adds_up_instant_by_instant() {
    let levels = [0.1f32, 0.2, 0.4, 0.8, 0.6, 0.5, 0.9];
    let scenes: Vec<Frame> = levels.iter().map(|&v| Frame::filled(SIZE, v)).collect();
    let instants: Vec<&Frame> = scenes.iter().collect();
    let light = Light { ppp: 6.0, mean_level: 0.5 };

    let mut camera = Camera::new(&binary(7), SIZE, light, 1).unwrap();
    let counts = vec![camera.expose(0, &instants).unwrap()];
    let fire = levels.map(|v| -(-f64::from(v) * 6.0 / 0.5 / 7.0).exp_m1());
    let (mean, variance) = moments(&counts);
    let expected: f64 = fire.iter().sum();
    let expected_variance: f64 = fire.iter().map(|p| p * (1.0 - p)).sum();
    assert!((mean - expected).abs() < 5.0 * (expected_variance / 262_144.0).sqrt());
    assert!((variance / expected_variance - 1.0).abs() < 0.02);

    let sensor = linear(12, 1.0, 0.0, f64::INFINITY);
    let mut camera = Camera::new(&sensor, SIZE, light, 1).unwrap();
    let counts = vec![camera.expose(0, &instants).unwrap()];
    let lambda = levels.iter().map(|&v| f64::from(v)).sum::<f64>() / 7.0 * 12.0;
    let z =
        chi_square_z(&histogram(&counts, 4095), &CountLaw::new(&sensor, 1.0).probabilities(lambda));
    assert!(z < 4.5, "z = {z}");
}

#[test]
fn crosstalk_fires_neighbours_with_its_probability() {
    let (p, px) = (0.1f64, 0.05);
    let mut sensor = binary(1);
    sensor.defects.crosstalk = px;
    let frames = expose_flat(&sensor, -(-p).ln_1p(), 8);
    let interior = |frame: &Vec<u16>| -> Vec<u16> {
        let rows = frame.chunks(SIZE.width).skip(1).take(SIZE.height - 2);
        rows.flat_map(|row| row[1..SIZE.width - 1].to_vec()).collect()
    };
    let (mean, _) = moments(&frames.iter().map(interior).collect::<Vec<_>>());
    let expected = 1.0 - (1.0 - p) * (1.0 - px * p).powi(4);
    let error = (expected * (1.0 - expected) / (8.0 * 262_144.0)).sqrt();
    assert!((mean - expected).abs() < 6.0 * error, "{mean} {expected}");

    // On a linear sensor thinned Poisson shares add up to a Poisson law.
    let mut sensor = linear(8, 1.0, 0.0, f64::INFINITY);
    sensor.defects.crosstalk = px;
    let frames: Vec<_> = expose_flat(&sensor, 4.2, 4).iter().map(interior).collect();
    let law = CountLaw::new(&sensor, 1.0);
    // Neighbouring counts are correlated, which widens the statistic a little.
    let z = chi_square_z(&histogram(&frames, 255), &law.probabilities(4.2 * (1.0 + 4.0 * px)));
    assert!(z < 6.0, "z = {z}");
}

#[test]
fn afterpulsing_reaches_its_stationary_rate() {
    let (p, pa) = (0.2f64, 0.1);
    let mut sensor = binary(1);
    sensor.defects.afterpulse = pa;
    let frames = expose_flat(&sensor, -(-p).ln_1p(), 20);
    let (first, _) = moments(&frames[..1]);
    assert!((first - p).abs() < 6.0 * (p * (1.0 - p) / 262_144.0).sqrt());
    let (late, _) = moments(&frames[10..]);
    let expected = p / (1.0 - (1.0 - p) * pa);
    assert!((late - expected).abs() < 6.0 * (expected / 2_621_440.0).sqrt(), "{late} {expected}");
}

#[test]
fn dead_time_counts_follow_renewal_theory() {
    for (lambda, dead_time_ns) in [(5.0, 50.0), (50.0, 20.0), (300.0, 10.0)] {
        let mut sensor = linear(12, 1.0, 0.0, f64::INFINITY);
        sensor.fps = Some(1e6); // 1 us exposures
        sensor.defects.dead_time_ns = dead_time_ns;
        let frames = expose_flat(&sensor, lambda, 2);
        let law = CountLaw::new(&sensor, 1.0);
        let z = chi_square_z(&histogram(&frames, 4095), &law.probabilities(lambda));
        assert!(z < 4.5, "lambda {lambda}: z = {z}");
        // And the textbook rate, up to the start of the exposure.
        let (mean, _) = moments(&frames);
        let textbook = lambda / (1.0 + lambda * dead_time_ns * 1e-3);
        assert!((mean - textbook).abs() < 1.0, "{mean} {textbook}");
    }
}

#[test]
fn pixel_maps_have_the_asked_for_statistics() {
    let mut sensor = binary(1);
    sensor.fps = Some(10_000.0);
    sensor.dark = DarkRate::PerSecond(10.0);
    sensor.defects.dark_spread = 0.5;
    sensor.defects.hot_fraction = 0.02;
    sensor.defects.hot_dark = DarkRate::PerSecond(5000.0);
    sensor.defects.dead_fraction = 0.01;
    let camera = Camera::new(&sensor, SIZE, Light { ppp: 1.0, mean_level: 0.5 }, 3).unwrap();
    let maps = camera.maps();
    let n = 262_144.0;
    assert!((maps.hot.len() as f64 / n - 0.02).abs() < 6.0 * (0.02f64 / n).sqrt());
    assert!((maps.dead.len() as f64 / n - 0.01).abs() < 6.0 * (0.01f64 / n).sqrt());
    let map = maps.dark.as_ref().unwrap();
    assert!(maps.hot.iter().all(|&i| (map[i] - 0.5).abs() < 1e-6));
    let good: Vec<f64> = map.iter().filter(|d| **d < 0.4).map(|&d| f64::from(d)).collect();
    let mean = good.iter().sum::<f64>() / good.len() as f64;
    // Lognormal: mean = median * exp(spread^2 / 2).
    assert!((mean / (1e-3 * 0.125f64.exp()) - 1.0).abs() < 0.01, "{mean}");
}

#[test]
fn hot_and_dead_pixels_read_their_values() {
    let mut sensor = binary(1);
    sensor.dark = DarkRate::PerFrame(0.0);
    sensor.defects.hot_fraction = 0.01;
    sensor.defects.hot_dark = DarkRate::PerFrame(0.7);
    sensor.defects.dead_fraction = 0.01;
    let mut camera = Camera::new(&sensor, SIZE, Light { ppp: 0.0, mean_level: 0.5 }, 3).unwrap();
    let scene = Frame::filled(SIZE, 0.5);
    let frames: Vec<_> = (0..20).map(|t| camera.expose(t, &[&scene]).unwrap()).collect();
    let hot = camera.maps().hot.clone();
    let fired: usize = frames.iter().map(|f| hot.iter().filter(|&&i| f[i] == 1).count()).sum();
    let rate = fired as f64 / (20 * hot.len()) as f64;
    let expected = 1.0 - (-0.7f64).exp();
    assert!((rate - expected).abs() < 0.01, "{rate} {expected}");
    // In the dark nothing else fires.
    assert_eq!(fired, frames.iter().flatten().filter(|&&c| c > 0).count());

    let mut camera = Camera::new(&sensor, SIZE, Light { ppp: 50.0, mean_level: 0.5 }, 3).unwrap();
    let bright = camera.expose(0, &[&scene]).unwrap();
    assert!(camera.maps().dead.iter().all(|&i| bright[i] == 0));
    assert!(bright.iter().filter(|&&c| c == 0).count() == camera.maps().dead.len());
}

#[test]
fn linear_estimates_are_unbiased_where_nothing_saturates() {
    for (sensor, ppp) in [
        (linear(12, 1.0, 0.3, f64::INFINITY), 9.75),
        (Sensor::load("qis16-gj").unwrap(), 3.25),
        (binary(255), 20.0),
    ] {
        let dark = sensor.dark_per_frame().unwrap();
        let gain = sensor.gain_at(ppp).unwrap();
        let frames = expose_flat(&sensor, sensor.quantum_efficiency * ppp + dark, 4);
        // Per pixel over 4 frames, then the mean over pixels.
        let pixels = SIZE.pixels();
        let sum = |i: usize| frames.iter().map(|f| f64::from(f[i])).sum::<f64>();
        let mean = (0..pixels).map(|i| sensor.estimate_flux(sum(i), 4, gain, dark)).sum::<f64>()
            / pixels as f64;
        assert!((mean / ppp - 1.0).abs() < 0.01, "{}: {mean} for {ppp}", sensor.name);
    }
}

#[test]
fn saturated_estimates_stay_finite() {
    let one = binary(1);
    assert!(one.estimate_flux(1.0, 1, 1.0, 0.0).is_finite());
    assert!(
        binary(7).estimate_flux(77.0, 11, 1.0, 0.0) > binary(7).estimate_flux(70.0, 11, 1.0, 0.0)
    );
}
