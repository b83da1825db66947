//! Hot and dead pixels, dark maps, calibration: found, stored, used.

use crate::{npy, open, plain, scratch, write};
use qudi_core::bad_pixels::BadPixels;
use qudi_core::sensor::{Gain, Sensor};
use qudi_core::{Camera, Frame, Light, Size};
use qudi_io::capture::{Capture, calibrate};
use qudi_io::description::{MaskChoice, ReadOptions};
use qudi_sim::clip::{Input, Sampling};
use std::ops::ControlFlow;
use std::path::Path;

fn sensor(document: &str) -> Sensor {
    Sensor::from_document(toml::from_str(document).unwrap(), "test").unwrap()
}

/// Simulated counts as an unpacked `.npy`, and the pixels that were made hot and dead.
fn simulate(
    folder: &Path,
    sensor: &Sensor,
    scene: &Frame,
    ppp: f64,
    frames: u64,
) -> std::path::PathBuf {
    let light = Light { ppp, mean_level: 0.4 };
    let mut camera = Camera::new(sensor, scene.size, light, 5).unwrap();
    let mut data = Vec::new();
    for frame in 0..frames {
        data.extend(camera.expose(frame, &[scene]).unwrap().iter().flat_map(|c| c.to_le_bytes()));
    }
    let shape = format!("({frames}, {}, {})", scene.size.height, scene.size.width);
    write(folder, "capture.npy", &npy("<u2", "False", &shape, &data))
}

const DEFECTIVE: &str = r#"
name = "test"
response = "binary"
bits = 1
quantum_efficiency = 0.5
dark = "20/s"
fps = 20000
full_well = 1
frames_summed = 7
[defects]
seed = 3
hot_fraction = 0.004
hot_dark = "6000/s"
dead_fraction = 0.002
"#;

#[test]
fn finds_hot_and_dead_pixels_of_a_textured_scene() {
    let folder = scratch();
    let size = Size { height: 128, width: 160 };
    let sensor = sensor(DEFECTIVE);
    for name in ["scene:dead-leaves", "scene:text", "scene:chart"] {
        let input = Input::parse(name, None, Some(size), 2, 0.0).unwrap();
        let sampling = Sampling { frames: Some(1), ..Sampling::default() };
        let scene = input.open(&sampling).unwrap().next().unwrap().unwrap().instants.remove(0);
        let path = simulate(folder.path(), &sensor, &scene, 0.6, 200);
        let maps = qudi_core::sensor::PixelMaps::draw(&sensor, size).unwrap();
        let options = ReadOptions { bits: Some(3), ..ReadOptions::default() };
        let capture = open(&path, &options).unwrap();
        let found = capture.bad_pixels();
        let right = maps.hot.iter().filter(|i| found.hot.contains(i)).count();
        let false_alarms = found.hot.iter().filter(|i| !maps.hot.contains(i)).count();
        // Hot pixels in bright places hide there; those outshine nothing.
        assert!(right * 10 >= maps.hot.len() * 8, "{name}: {right} of {}", maps.hot.len());
        assert!(false_alarms * 20_000 <= size.pixels(), "{name}: {false_alarms} false alarms");
        let dead = maps.dead.iter().filter(|i| found.dead.contains(i)).count();
        assert!(dead * 2 >= maps.dead.len(), "{name}: {dead} of {} dead", maps.dead.len());
        assert!(found.dead.iter().all(|i| maps.dead.contains(i)), "{name}");
    }
}

#[test]
fn finds_no_bad_pixels_in_a_clean_capture() {
    let size = Size { height: 96, width: 96 };
    for (seed, rate) in [(1, 3u32), (2, 40)] {
        let frames = crate::scene(60, 96, 96, seed);
        let sums: Vec<u32> = (0..size.pixels())
            .map(|i| frames.iter().map(|f| u32::from(f[i])).sum::<u32>() * rate / 3)
            .collect();
        assert!(BadPixels::find(&sums, size, 60, Some(1)).is_empty());
    }
}

#[test]
fn repaired_pixels_follow_their_neighbours() {
    let folder = scratch();
    // A constant picture of 5 with one pixel at 60000.
    let mut frame = [5u16; 64];
    frame[27] = 60_000;
    let data: Vec<u8> = frame.repeat(3).iter().flat_map(|c| c.to_le_bytes()).collect();
    let path = write(folder.path(), "a.npy", &npy("<u2", "False", "(3, 8, 8)", &data));
    let mut capture = open(&path, &ReadOptions::default()).unwrap();
    assert_eq!(capture.bad_pixels().hot, [27]);
    let mut counts = vec![0; 64];
    capture.read(1, &mut counts).unwrap();
    assert_eq!(counts, [5; 64]);
    let mut sums = vec![0; 64];
    capture.total(0..3, &mut sums).unwrap();
    assert_eq!(sums, [15; 64]);
    let mut as_is = open(&path, &plain()).unwrap();
    as_is.read(1, &mut counts).unwrap();
    assert_eq!(counts[27], 60_000);
}

#[test]
fn masks_and_dark_maps_come_from_files() {
    let folder = scratch();
    let data: Vec<u8> = (0..4 * 12).map(|i| i % 3).collect();
    let path = write(folder.path(), "a.npy", &npy("|u1", "False", "(4, 3, 4)", &data));
    let mut mask = vec![0u8; 12];
    mask[5] = 1;
    let file = write(folder.path(), "mask.npy", &npy("|b1", "False", "(3, 4)", &mask));
    let options = ReadOptions {
        mask: MaskChoice::File(file),
        pack_axis: Some(qudi_io::description::PackAxis::None),
        ..ReadOptions::default()
    };
    assert_eq!(open(&path, &options).unwrap().bad_pixels().hot, [5]);
    // Turned and cropped along with the frames: pixel (1, 1) of 3 x 4 is (2, 1) of its rot90.
    let turned = ReadOptions {
        orient: Some(qudi_io::description::Orientation::Rot90),
        crop: Some("1:4,1:3".parse().unwrap()),
        ..options.clone()
    };
    assert_eq!(open(&path, &turned).unwrap().bad_pixels().hot, [2]);
    let rates: Vec<u8> = (0..12u16).flat_map(|i| (f32::from(i) * 20.0).to_le_bytes()).collect();
    let dcr = write(folder.path(), "dcr.npy", &npy("<f4", "False", "(3, 4)", &rates));
    let options = ReadOptions { dcr: Some(dcr), mask: MaskChoice::Auto, ..options };
    let sensor = Sensor { fps: Some(1000.0), ..Sensor::load("swissspad2").unwrap() };
    let capture = Capture::open(&path, &options, Some(&sensor)).unwrap();
    assert_eq!(capture.bad_pixels().hot, [6, 7, 8, 9, 10, 11], "beyond 100 per second");
    assert_eq!(capture.dark().unwrap()[3], 0.06);
    let small = write(folder.path(), "small.npy", &npy("|b1", "False", "(2, 2)", &[0; 4]));
    let options = ReadOptions { mask: MaskChoice::File(small), dcr: None, ..options };
    assert!(crate::refusal(open(&path, &options)).contains("a map of 2 x 2 for frames of 3 x 4"));
}

#[test]
fn calibration_of_a_binary_camera_recovers_its_map() {
    let folder = scratch();
    let size = Size { height: 60, width: 80 };
    let truth = sensor(
        &DEFECTIVE
            .replace("\"20/s\"", "\"200/s\"")
            .replace("[defects]", "[defects]\ndark_spread = 0.4"),
    );
    let black = Frame::filled(size, 0.0);
    let path = simulate(folder.path(), &truth, &black, 0.6, 3000);
    let options = ReadOptions { bits: Some(3), ..plain() };
    let mut capture = open(&path, &options).unwrap();
    let found =
        calibrate(&mut capture, &truth, None, None, None, &mut |_, _| ControlFlow::Continue(()))
            .unwrap();
    let maps = qudi_core::sensor::PixelMaps::draw(&truth, size).unwrap();
    assert_eq!(found.bad.hot, maps.hot);
    let dark = maps.dark.unwrap();
    // 21000 binary frames of about 0.01 dark counts: 7 % per pixel, no bias over all.
    let mut ratio = 0.0;
    let good: Vec<usize> = (0..size.pixels()).filter(|i| !maps.dead.contains(i)).collect();
    for &i in &good {
        let sigma = (f64::from(dark[i]) / 21_000.0).sqrt();
        assert!((f64::from(found.dark[i]) - f64::from(dark[i])).abs() < 6.0 * sigma + 1e-6, "{i}");
        ratio += f64::from(found.dark[i]) / f64::from(dark[i]);
    }
    let ratio = ratio / good.len() as f64;
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    assert!((found.bulk / 0.01 - 1.0).abs() < 0.05, "{}", found.bulk);
}

#[test]
fn calibration_of_a_linear_camera_recovers_dark_and_read_noise() {
    let size = Size { height: 60, width: 80 };
    let folder = scratch();
    let black = Frame::filled(size, 0.0);
    for (dark, read_noise) in [(1.6, 0.2), (0.3, 0.35), (4.0, 1.2)] {
        let truth = Sensor {
            dark: qudi_core::sensor::DarkRate::PerFrame(dark),
            read_noise,
            bits: 6,
            gain: Gain::Fixed(1.5),
            ..Sensor::load("qudi-paper").unwrap()
        };
        let path = simulate(folder.path(), &truth, &black, 1.0, 300);
        let options = ReadOptions { bits: Some(6), ..plain() };
        let mut capture = open(&path, &options).unwrap();
        let base = Sensor {
            dark: qudi_core::sensor::DarkRate::PerFrame(0.0),
            read_noise: 0.0,
            ..truth.clone()
        };
        let found = calibrate(&mut capture, &base, Some(1.5), None, None, &mut |_, _| {
            ControlFlow::Continue(())
        })
        .unwrap();
        assert!((found.bulk / dark - 1.0).abs() < 0.03, "{} for {dark}", found.bulk);
        let noise = found.read_noise.unwrap();
        assert!((noise / read_noise - 1.0).abs() < 0.1, "{noise} for {read_noise}");
    }
    let mut capture = open(&folder.path().join("capture.npy"), &plain()).unwrap();
    let paper = Sensor::load("qudi-paper").unwrap();
    let error =
        calibrate(&mut capture, &paper, None, None, None, &mut |_, _| ControlFlow::Continue(()))
            .unwrap_err();
    assert!(error.to_string().contains("gain"), "{error}");
}

/// A pedestal is told from dark counts by their third moment, and from read noise by the mean.
#[test]
fn calibration_tells_pedestal_dark_and_read_noise_apart() {
    let folder = scratch();
    let camera = Sensor { bits: 12, gain: Gain::Fixed(2.0), ..Sensor::load("ideal").unwrap() };
    let mut state = 1_u64;
    let mut uniform = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    };
    let mut draw = |dark: f64, read_noise: f64, offset: f64| {
        let (mut electrons, mut product) = (-1.0, 1.0);
        while product > (-dark).exp() {
            product *= uniform();
            electrons += 1.0;
        }
        let normal = (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
        (offset + 2.0 * (f64::max(electrons, 0.0) + read_noise * normal)).round().max(0.0) as u16
    };
    for (dark, read_noise, offset) in [(0.0, 1.5, 100.0), (3.0, 1.0, 60.0), (30.0, 0.5, 0.0)] {
        let counts = (0..40 * 64 * 96).map(|_| draw(dark, read_noise, offset));
        let data: Vec<u8> = counts.flat_map(u16::to_le_bytes).collect();
        let path = write(folder.path(), "dark.npy", &npy("<u2", "False", "(40, 64, 96)", &data));
        for given in [None, Some(offset)] {
            let mut capture = open(&path, &plain()).unwrap();
            let mut go_on = |_, _| ControlFlow::Continue(());
            let found =
                calibrate(&mut capture, &camera, Some(2.0), given, None, &mut go_on).unwrap();
            let pedestal = found.pedestal.map_or(0.0, |pedestal| pedestal.offset);
            let case = format!("{dark} {read_noise} {offset} {given:?}: {pedestal} {}", found.bulk);
            assert!((found.bulk - dark).abs() < 0.05 + 0.05 * dark, "{case}");
            assert!((pedestal - offset).abs() < 0.3 + 0.1 * dark, "{case}");
            let noise = found.read_noise.unwrap();
            assert!((noise / read_noise - 1.0).abs() < 0.25 || dark > 9.0, "{case} {noise}");
            assert!(found.bad.hot.len() < 5, "{case}: {} hot", found.bad.hot.len());
        }
    }
}
