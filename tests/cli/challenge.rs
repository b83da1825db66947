//! Sets of the Single Photon Challenge, which the tests make in its layout.

use super::support::{npy_bytes, qudi, refused, run, scratch};
use image::{Rgb, RgbImage};
use std::fs::File;
use std::io::Read;
use std::path::Path;

const HEIGHT: u32 = 32;
const WIDTH: u32 = 48;

/// The linear value of a colour, by column, row and share of the time that has passed.
type Scene = fn(u32, u32, f64) -> [f64; 3];

/// Smooth in space, static, with different colours.
pub(crate) fn still(x: u32, y: u32, _: f64) -> [f64; 3] {
    let (x, y) = (f64::from(x) / f64::from(WIDTH), f64::from(y) / f64::from(HEIGHT));
    [0.2 + 0.6 * x, 0.8 - 0.5 * y, 0.3]
}

/// Dark on the left at first, and on the right in the last quarter; no blue.
fn turning(x: u32, _: u32, time: f64) -> [f64; 3] {
    let value = if (x < WIDTH / 2) == (time < 0.75) { 0.05 } else { 0.9 };
    [value, value, 0.0]
}

fn srgb(linear: f64) -> u8 {
    let value =
        if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (255.0 * value).round() as u8
}

/// Writes a cube of packed planes, and the true picture of its last one.
pub(crate) fn write_cube(set: &Path, name: &str, planes: u32, with_truth: bool, scene: Scene) {
    let path = set.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let (mut state, mut bytes) = (1u64, Vec::new());
    let mut uniform = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    for plane in 0..planes {
        let time = f64::from(plane) / f64::from(planes);
        for y in 0..HEIGHT {
            for byte in 0..WIDTH / 8 {
                let mut packed = [0u8; 3];
                for x in 8 * byte..8 * byte + 8 {
                    for (colour, value) in scene(x, y, time).into_iter().enumerate() {
                        let fires = uniform() < 1.0 - (-0.5 * value).exp();
                        packed[colour] = packed[colour] << 1 | u8::from(fires);
                    }
                }
                bytes.extend(packed);
            }
        }
    }
    let shape = format!("({planes}, {HEIGHT}, {}, 3)", WIDTH / 8);
    std::fs::write(path.with_extension("npy"), npy_bytes("|u1", &shape, &bytes)).unwrap();
    if with_truth {
        let truth = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb(scene(x, y, 1.0).map(srgb)));
        truth.save(path.with_extension("png")).unwrap();
    }
}

/// Returns the pictures in an archive by name.
fn pictures(path: &Path) -> Vec<(String, RgbImage)> {
    let mut archive = zip::ZipArchive::new(File::open(path).unwrap()).unwrap();
    let mut pictures = Vec::new();
    for number in 0..archive.len() {
        let mut entry = archive.by_index(number).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        pictures.push((
            entry.name().unwrap().into_owned(),
            image::load_from_memory(&bytes).unwrap().into_rgb8(),
        ));
    }
    pictures
}

/// Returns the mean squared error of 8-bit pictures, in decibels.
fn psnr(picture: &RgbImage, truth: &RgbImage) -> f64 {
    let pairs = picture.as_raw().iter().zip(truth.as_raw());
    let squares: f64 = pairs.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    20.0 * 255f64.log10() - 10.0 * (squares / f64::from(3 * HEIGHT * WIDTH)).log10()
}

#[test]
fn restores_and_scores_a_set_of_the_challenge() {
    let folder = scratch("challenge");
    let set = folder.join("train");
    write_cube(&set, "attic/000010", 256, true, still);
    write_cube(&set, "attic/000002", 256, false, still);
    write_cube(&set, "hall/000000", 256, true, turning);
    std::fs::write(set.join("readme.txt"), "not a scene").unwrap();
    std::fs::write(set.join("hall/notes.txt"), "not a cube").unwrap();
    let printed =
        run(&folder, "restore train --challenge --method mle --sum 8 -o train.zip --json");
    let document: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let pictures = pictures(&folder.join("train.zip"));
    let names: Vec<_> = pictures.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["attic/000002.png", "attic/000010.png", "hall/000000.png"]);
    let scores = document["scores"]["pictures"].as_array().unwrap();
    assert_eq!(scores.len(), 2, "{document}");
    for (score, at) in scores.iter().zip([1, 2]) {
        let (name, picture) = &pictures[at];
        assert_eq!(*name, format!("{}.png", score["name"].as_str().unwrap()));
        let truth = image::open(set.join(name)).unwrap().into_rgb8();
        let expected = psnr(picture, &truth);
        assert!((score["psnr"].as_f64().unwrap() - expected).abs() < 1e-6, "{score} {expected}");
        // The brightness is the scene's own, and the scene is as it was in the end.
        assert!(expected > 17.0, "{name}: {expected}");
    }
    let turned = &pictures[2].1;
    let mean = |columns: std::ops::Range<u32>, colour: usize| {
        let pixels = columns.flat_map(|x| (0..HEIGHT).map(move |y| (x, y)));
        pixels.map(|(x, y)| u32::from(turned.get_pixel(x, y)[colour])).sum::<u32>()
            / (WIDTH / 2 * HEIGHT)
    };
    assert!(mean(0..24, 0) > 200 && mean(24..48, 0) < 100, "the last planes, not the first");
    assert_eq!(mean(0..48, 2), 0, "no blue photon, no blue");
}

/// The method and its sums are chosen by the cube, once for all colours.
#[test]
fn chooses_method_and_sums_of_a_cube() {
    let folder = scratch("challenge-default");
    write_cube(&folder.join("set"), "attic/000000", 154, true, still);
    let printed = run(&folder, "restore set --challenge -o out.zip");
    assert!(printed.starts_with("out.zip   1 picture by q"), "{printed}");
    let line = printed.lines().find(|line| line.contains("psnr")).unwrap();
    let mean: f64 = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    assert!(mean > 25.0, "{printed}");
    refused(&folder, "restore set --challenge -o out.zip", &["exists already"]);
}

#[test]
fn refuses_what_is_no_set_of_the_challenge() {
    let folder = scratch("challenge-refused");
    let set = folder.join("set");
    write_cube(&set, "attic/000000", 16, false, still);
    refused(&folder, "restore set --challenge -o frames", &["zip"]);
    refused(&folder, "restore set/attic --challenge -o out.zip", &["no cubes"]);
    refused(&folder, "restore set/attic/000000.npy --challenge -o out.zip", &["cannot list"]);
    let output = qudi(&folder)
        .args("restore set --challenge --ppp 3 -o out.zip".split(' '))
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    refused(
        &folder,
        "restore set --challenge --backbones . -o out.zip",
        &["no weights of LPIPS", "scripts/convert/lpips.py"],
    );
    let output =
        qudi(&folder).args(["restore", "x.npy", "--backbones", ".", "-o", "o"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "--backbones needs --challenge");
    assert!(!folder.join("out.zip.unfinished").exists());
    RgbImage::new(8, 8).save(set.join("attic/000000.png")).unwrap();
    refused(&folder, "restore set --challenge -o out.zip", &["true picture of 8 x 8"]);
    std::fs::write(set.join("attic/000000.npy"), npy_bytes("|u1", "(2, 4, 6)", &[0; 48])).unwrap();
    refused(&folder, "restore set --challenge -o out.zip", &["no packed cube"]);
    assert!(!folder.join("out.zip").exists());
}

/// A killed run goes on after the last finished picture, and makes the same archive; a run with other
/// settings is refused.
#[test]
fn goes_on_after_an_interruption() {
    let folder = scratch("challenge-resumed");
    for number in 0..12 {
        write_cube(&folder.join("set"), &format!("attic/{number:06}"), 128, true, still);
    }
    let command = "restore set --challenge --method qbp-bm3d --sum 8";
    let mut killed = std::process::Command::new(env!("CARGO_BIN_EXE_qudi"))
        .current_dir(&folder)
        .args(format!("{command} -o out.zip -q").split(' '))
        .spawn()
        .unwrap();
    let second = folder.join("out.zip.unfinished/frame_000001.png");
    let end = std::time::Instant::now() + std::time::Duration::from_mins(2);
    while !second.exists() {
        assert!(std::time::Instant::now() < end, "no picture appeared");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    assert!(!folder.join("out.zip").exists(), "nothing half-written");
    refused(
        &folder,
        "restore set --challenge --method qbp-bm3d --sum 4 -o out.zip",
        &["other settings", "sum was"],
    );
    let printed = run(&folder, &format!("{command} -o out.zip --json"));
    let document: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let resumed = document["resumed_pictures"].as_u64().unwrap();
    assert!((2..12).contains(&resumed), "{resumed}");
    assert_eq!(document["methods"], serde_json::json!(["qbp-bm3d"]));
    assert!(!folder.join("out.zip.unfinished").exists());
    let printed = run(&folder, &format!("{command} -o whole.zip --json"));
    let whole: serde_json::Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(whole["resumed_pictures"], 0);
    assert_eq!(document["scores"], whole["scores"]);
    let archives = ["out.zip", "whole.zip"].map(|name| std::fs::read(folder.join(name)).unwrap());
    assert_eq!(archives[0], archives[1]);
}
