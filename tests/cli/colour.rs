//! Captures behind a colour filter array: simulated, described, restored, scored.

use crate::support::{npy_bytes, qudi, refused, run, scratch};
use std::path::{Path, PathBuf};

const FRAMES: usize = 11;
const HEIGHT: usize = 64;
const WIDTH: usize = 96;

/// Writes a colour clip: a texture of slowly changing hue that moves.
fn clip(folder: &Path) {
    let mut bytes = Vec::new();
    for t in 0..FRAMES {
        for i in 0..HEIGHT * WIDTH {
            let x = (i % WIDTH) as f32 - 0.5 * t as f32;
            let y = (i / WIDTH) as f32 + 0.3 * t as f32;
            // It does not repeat itself: motion is known.
            let (u, v) = (0.5 * x + 3.0 * (0.13 * x).sin(), 0.4 * y + 2.0 * (0.17 * y).cos());
            let luma = 0.35 + 0.1 * (u + 0.5 * v).sin() + 0.1 * (v - 0.6 * u).sin();
            for k in 0..3 {
                let hue = 0.07 * x - 0.05 * y + 2.1 * k as f32;
                bytes.extend((luma * (1.0 + 0.5 * hue.sin())).to_le_bytes());
            }
        }
    }
    let shape = format!("({FRAMES}, {HEIGHT}, {WIDTH}, 3)");
    std::fs::write(folder.join("clip.npy"), npy_bytes("<f4", &shape, &bytes)).unwrap();
}

/// Exposes the clip behind a filter; the truth goes to `t.npy`.
fn exposed(name: &str, cfa: &str) -> PathBuf {
    let folder = scratch(name);
    clip(&folder);
    let simulate = "simulate clip.npy -o m.npy --truth t.npy --ppp 3.25 --seed 3 --cfa";
    run(&folder, &format!("{simulate} {cfa}"));
    folder
}

/// Runs the program, which must succeed, and returns all that it prints.
fn printed(folder: &Path, args: &str) -> String {
    let output = qudi(folder).args(args.split_whitespace()).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text).split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(output.status.success(), "{args}: {text}");
    text
}

fn document(folder: &Path, args: &str) -> serde_json::Value {
    serde_json::from_str(&run(folder, args)).unwrap()
}

#[test]
fn colours_of_a_mosaic_are_restored() {
    let folder = exposed("colour-restore", "rggb");
    let text = run(&folder, "info m.npy");
    assert!(text.contains("rggb@0,0: mean counts red") && text.contains("blue"), "{text}");
    run(&folder, "restore m.npy -o c.npy --method qbp-refined");
    let shape = npy_shape(&folder.join("c.npy"));
    assert_eq!(shape, format!("({FRAMES}, {HEIGHT}, {WIDTH}, 3)"));
    let scores = document(&folder, "eval t.npy --restored c.npy --json");
    let linear = scores["cpsnr_linear"].as_f64().unwrap();
    assert!(linear > 27.0, "{scores}");
    assert!(scores["ciede2000_median"].as_f64().unwrap() < 6.0, "{scores}");
    let both = ["eval", "t.npy", "--restored", "c.npy", "--method", "qbp"];
    let output = qudi(&folder).args(both).output().unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot be used with"));
    // Without its colours, the clip is far from itself.
    run(&folder, "restore m.npy -o g.npy --method qbp-refined --gray");
    assert_eq!(npy_shape(&folder.join("g.npy")), format!("({FRAMES}, {HEIGHT}, {WIDTH})"));
}

#[test]
fn colours_of_images_are_decoded_from_srgb() {
    let folder = scratch("colour-transfer");
    let pixel = |x: u32, y: u32| image::Rgb([40 + 2 * x as u8, 90, 60 + 3 * y as u8]);
    image::RgbImage::from_fn(48, 32, pixel).save(folder.join("s.png")).unwrap();
    let simulate = "simulate s.png -o m.npy --cfa rggb --ppp 3.25 --frames 2 --seed 1";
    refused(&folder, &format!("{simulate} --transfer as-is"), &["decoded from sRGB"]);
    run(&folder, simulate);
    let record = std::fs::read_to_string(folder.join("m.npy.json")).unwrap();
    let record: serde_json::Value = serde_json::from_str(&record).unwrap();
    assert_eq!(record["simulation"]["sampling"]["transfer"], "srgb");
}

#[test]
fn three_full_planes_are_restored_together() {
    let folder = scratch("colour-full");
    clip(&folder);
    let clip = std::fs::read(folder.join("clip.npy")).unwrap();
    let values = &clip[clip.len() - 4 * 3 * FRAMES * HEIGHT * WIDTH..];
    let mut counts = vec![0; 3 * FRAMES * HEIGHT * WIDTH];
    for k in 0..3 {
        let plane: Vec<u8> =
            values.chunks_exact(12).flat_map(|v| v[4 * k..4 * k + 4].to_vec()).collect();
        let shape = format!("({FRAMES}, {HEIGHT}, {WIDTH})");
        std::fs::write(folder.join("p.npy"), npy_bytes("<f4", &shape, &plane)).unwrap();
        let simulate = "simulate p.npy -o q.npy --exposure 0.35 --ppp 3.25 --transfer as-is";
        run(&folder, &format!("{simulate} --seed {k} --force"));
        let bytes = std::fs::read(folder.join("q.npy")).unwrap();
        let plane = &bytes[bytes.len() - FRAMES * HEIGHT * WIDTH..];
        for (i, &count) in plane.iter().enumerate() {
            counts[3 * i + k] = count;
        }
    }
    let shape = format!("({FRAMES}, {HEIGHT}, {WIDTH}, 3)");
    std::fs::write(folder.join("full.npy"), npy_bytes("|u1", &shape, &counts)).unwrap();
    let restore =
        "restore full.npy --sensor qudi-paper --bits 3 --ppp 3.25 --exposure 0.35 --sum 1";
    run(&folder, &format!("{restore} -o c.npy --method qbp-refined"));
    let scores = document(&folder, "eval clip.npy --restored c.npy --json");
    assert!(scores["cpsnr_linear"].as_f64().unwrap() > 30.0, "{scores}");
    run(&folder, &format!("{restore} -o g.npy --method average --gray"));
    assert_eq!(npy_shape(&folder.join("g.npy")), format!("({FRAMES}, {HEIGHT}, {WIDTH})"));
    run(&folder, &format!("{restore} -o one.npy --method average --channel 2"));
    assert_eq!(npy_shape(&folder.join("one.npy")), format!("({FRAMES}, {HEIGHT}, {WIDTH})"));
    refused(&folder, &format!("{restore} -o x.npy --cfa rggb"), &["every pixel has all colours"]);
    // An interrupted run goes on with the same balance, and measures no colours of the run before.
    let pictures = format!("{restore} -o pictures --method average --wb");
    run(&folder, &format!("{pictures} 1,1,1"));
    std::fs::remove_file(folder.join("pictures/frame_000010.png")).unwrap();
    refused(&folder, &format!("{pictures} 2,1,0.2"), &["white_balance"]);
    for measured in ["--chi-map m.npy", "--side-by-side s.png"] {
        let flag = measured.split(' ').next().unwrap();
        refused(&folder, &format!("{pictures} 1,1,1 {measured}"), &[flag]);
    }
    run(&folder, &format!("{pictures} 1,1,1"));
}

/// One plane of a recorded mosaic is gray, and stays it once it is converted.
#[test]
fn planes_of_a_mosaic_are_converted_to_gray() {
    let folder = exposed("colour-plane", "rggb");
    run(&folder, "convert m.npy --channel 1 -o plane.npy");
    let info: serde_json::Value = document(&folder, "info plane.npy --json");
    assert_eq!(info["colours"], serde_json::Value::Null, "{info}");
    run(&folder, "restore plane.npy -o p.npy --method average");
    assert_eq!(npy_shape(&folder.join("p.npy")).matches(',').count(), 2);
}

#[test]
fn uncertainties_are_of_every_colour() {
    let folder = exposed("colour-uncertainty", "rggb");
    run(&folder, "restore m.npy -o c.npy --uncertainty u.npy");
    assert_eq!(npy_shape(&folder.join("u.npy")), npy_shape(&folder.join("c.npy")));
    run(&folder, "restore m.npy -o g.npy --gray --uncertainty v.npy");
    assert_eq!(npy_shape(&folder.join("v.npy")), npy_shape(&folder.join("g.npy")));
}

#[test]
fn pictures_are_balanced_and_the_manifest_has_the_names_of_dng() {
    let folder = exposed("colour-picture", "gbrg");
    let restore = "restore m.npy --method average --wb 2,1,0.5 --end 3";
    run(&folder, &format!("{restore} -o f"));
    run(&folder, &format!("{restore} -o f.tif --float"));
    let image = image::open(folder.join("f/frame_000000.png")).unwrap();
    assert_eq!(image.color(), image::ColorType::Rgb16);
    let manifest = std::fs::read_to_string(folder.join("f/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let dng = &manifest["settings"]["dng"];
    assert_eq!(dng["CFAPattern"], serde_json::json!([1, 2, 0, 1]));
    assert_eq!(dng["AsShotNeutral"], serde_json::json!([0.5, 1.0, 2.0]));
    assert_eq!(dng["WhiteLevel"], 7);
    let mean = |k: usize| {
        let samples = image.as_rgb16().unwrap().pixels().map(|pixel| f64::from(pixel.0[k]));
        samples.sum::<f64>() / (65535 * HEIGHT * WIDTH) as f64
    };
    assert!(mean(0) > 1.2 * mean(1) && mean(1) > 1.2 * mean(2), "gains brighten red");
    let text = run(&folder, "restore m.npy --method average -o g.gif --end 2");
    assert!(text.contains("a guess"), "{text}");
}

#[test]
fn a_picture_of_the_filter_is_turned_with_the_frames() {
    let folder = scratch("colour-filter");
    clip(&folder);
    let colours = [[255, 0, 0], [0, 255, 0], [0, 255, 0], [0, 0, 255]];
    let pixel = |x: u32, y: u32| image::Rgb(colours[(y % 2 * 2 + x % 2) as usize]);
    let filter = image::RgbImage::from_fn(WIDTH as u32, HEIGHT as u32, pixel);
    filter.save(folder.join("rggb.png")).unwrap();
    let simulate = "simulate clip.npy --ppp 3.25 --seed 3";
    run(&folder, &format!("{simulate} -o a.npy --cfa rggb"));
    run(&folder, &format!("{simulate} -o b.npy --cfa rggb.png"));
    let bytes = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert_eq!(bytes("a.npy"), bytes("b.npy"));
    let restore = "--method average --crop 1:41,3:63 --orient flip-h";
    run(&folder, &format!("restore a.npy -o ca.npy {restore}"));
    run(&folder, &format!("restore b.npy -o cb.npy {restore}"));
    assert_eq!(bytes("ca.npy"), bytes("cb.npy"));
    image::RgbImage::from_fn(8, 8, pixel).save(folder.join("small.png")).unwrap();
    refused(&folder, "info a.npy --cfa small.png", &["a filter of 8 x 8", "64 x 96"]);
    let mut other = filter;
    other.put_pixel(5, 0, image::Rgb([250, 0, 0]));
    other.save(folder.join("other.png")).unwrap();
    refused(&folder, "info a.npy --cfa other.png", &["[250, 0, 0] at row 0, column 5"]);
    refused(&folder, "info a.npy --cfa rggb.png --channel 1", &["which is a picture"]);
}

#[test]
fn contradictions_are_refused() {
    let folder = exposed("colour-refused", "rggb");
    refused(&folder, "restore m.npy -o - --method average", &["not written as Y4M", "--gray"]);
    refused(&folder, "restore m.npy -o a.npy --wb 1,2", &["gains of red, green and blue"]);
    let full = "info clip8.npy --cfa rggb";
    let shape = format!("({FRAMES}, {HEIGHT}, {WIDTH}, 3)");
    let counts = vec![1; FRAMES * HEIGHT * WIDTH * 3];
    std::fs::write(folder.join("clip8.npy"), npy_bytes("|u1", &shape, &counts)).unwrap();
    refused(&folder, full, &["a colour filter in front of a capture of 3 channels"]);
    refused(&folder, "info clip8.npy", &["a colour capture of 3 channels", "--channel"]);
    run(&folder, "simulate scene:text --size 64x96 --frames 3 -o gray.npy --seed 1");
    refused(&folder, "restore gray.npy -o x.npy --gray", &["the capture is gray", "--gray"]);
    refused(&folder, "restore gray.npy -o x.npy --wb 1,1,1", &["the capture is gray", "--wb"]);
    refused(&folder, "simulate clip.npy -o x.npy --cfa cmyg", &["the colour `c`"]);
    refused(&folder, "simulate clip.npy -o x.npy --cfa rgxb", &["rggb@0,0"]);
    refused(&folder, "eval t.npy --restored gray.npy", &["holds no colour frames"]);
    refused(&folder, "eval m.npy --capture", &["colour filter rggb@0,0", "--channel"]);
}

/// Returns the shape in the header of a `.npy` file.
fn npy_shape(path: &Path) -> String {
    let bytes = std::fs::read(path).unwrap();
    let header = String::from_utf8_lossy(&bytes[..128]).into_owned();
    let shape = header.split("'shape': ").nth(1).unwrap();
    format!("{})", shape.split(')').next().unwrap())
}

#[test]
fn phases_that_the_picture_contradicts_are_refused() {
    let folder = exposed("colour-phase", "rggb");
    // A flat orange scene: red, green and blue differ everywhere.
    let mut bytes = Vec::new();
    for _ in 0..3 * 160 * 160 {
        bytes.extend([0.6f32, 0.35, 0.1].iter().flat_map(|value| value.to_le_bytes()));
    }
    std::fs::write(folder.join("flat.npy"), npy_bytes("<f4", "(3, 160, 160, 3)", &bytes)).unwrap();
    run(&folder, "simulate flat.npy -o f.npy --cfa rggb --ppp 20 --seed 2");
    std::fs::remove_file(folder.join("f.npy.json")).unwrap();
    let info = "info f.npy --bits 3 --cfa";
    run(&folder, &format!("{info} rggb"));
    refused(&folder, &format!("{info} rggb@0,1"), &["differ by", "rggb@0,1", "fit rggb or bggr"]);
    run(&folder, &format!("{info} bggr"));
    let converted = "convert f.npy -o g.npy --bits 3 --cfa";
    refused(&folder, &format!("{converted} grbg"), &["differ by", "behind grbg"]);
    let colours = [[0, 255, 0], [255, 0, 0], [0, 0, 255], [0, 255, 0]];
    let pixel = |x: u32, y: u32| image::Rgb(colours[(y % 2 * 2 + x % 2) as usize]);
    image::RgbImage::from_fn(160, 160, pixel).save(folder.join("shifted.png")).unwrap();
    refused(&folder, &format!("{info} shifted.png"), &["differ by", "shifted.png"]);
}

#[test]
fn the_kind_of_a_filter_shows_in_scenes_of_many_colours() {
    let folder = exposed("colour-kind", "quad-rggb");
    std::fs::remove_file(folder.join("m.npy.json")).unwrap();
    let unnamed = printed(&folder, "info m.npy --bits 3");
    assert!(unnamed.contains("name it (--cfa quad-rggb or quad-bggr)"), "{unnamed}");
    refused(&folder, "info m.npy --bits 3 --cfa rggb", &["behind rggb differ", "fit quad-rggb"]);
    refused(&folder, "info m.npy --bits 3 --cfa quad-rggb@1,0", &["fit quad-rggb or quad-bggr"]);
    run(&folder, "info m.npy --bits 3 --cfa quad-rggb");
    // Filters are named by the stored frame, whatever is read of it.
    let part = "info m.npy --bits 3 --crop 1:64,2:96 --orient flip-h";
    let unnamed = printed(&folder, part);
    assert!(unnamed.contains("name it (--cfa quad-"), "{unnamed}");
    assert!(
        unnamed.contains("quad-rggb or quad-bggr") || unnamed.contains("quad-bggr or quad-rggb")
    );
    run(&folder, &format!("{part} --cfa quad-rggb"));
}

#[test]
fn channels_are_letters_of_the_filter_that_a_record_or_a_sensor_names() {
    let folder = exposed("colour-channel", "rggb");
    let green = run(&folder, "info m.npy --channel 1");
    assert!(green.contains("32 x 48"), "{green}");
    std::fs::remove_file(folder.join("m.npy.json")).unwrap();
    let sensor = "base = \"qudi-paper\"\n[colour]\ncfa = \"rggb@0,0\"\n";
    std::fs::write(folder.join("camera.toml"), sensor).unwrap();
    let green = run(&folder, "info m.npy --channel 1 --sensor camera.toml");
    assert!(green.contains("32 x 48"), "{green}");
    // Full planes have channels of their own.
    let shape = format!("({FRAMES}, {HEIGHT}, {WIDTH}, 3)");
    let counts = vec![1; FRAMES * HEIGHT * WIDTH * 3];
    std::fs::write(folder.join("planes.npy"), npy_bytes("|u1", &shape, &counts)).unwrap();
    let plane = printed(&folder, "info planes.npy --channel 1");
    assert!(plane.contains("64 x 96"), "{plane}");
}

#[test]
fn restored_files_that_are_no_linear_light_are_named() {
    let folder = exposed("colour-doubts", "rggb");
    run(&folder, "restore m.npy -o c.npy --method qbp-refined");
    let linear = printed(&folder, "eval t.npy --restored c.npy");
    assert!(!linear.contains("warning"), "{linear}");
    run(&folder, "restore m.npy -o s.npy --method qbp-refined --tonemap srgb");
    let encoded = printed(&folder, "eval t.npy --restored s.npy");
    assert!(encoded.contains("decoded from sRGB, the restored frames would score"), "{encoded}");
}

/// Writes a flat red clip, and exposes it behind a filter as `m.npy`.
fn flat_red(name: &str) -> PathBuf {
    let folder = scratch(name);
    let pixels = (0..FRAMES * 64 * 64).flat_map(|_| [0.8f32, 0.2, 0.2]);
    let bytes: Vec<u8> = pixels.flat_map(f32::to_le_bytes).collect();
    let shape = format!("({FRAMES}, 64, 64, 3)");
    std::fs::write(folder.join("red.npy"), npy_bytes("<f4", &shape, &bytes)).unwrap();
    run(&folder, "simulate red.npy -o m.npy --cfa bggr --ppp 8 --seed 2");
    folder
}

#[test]
fn one_saturated_colour_is_warned_of() {
    let folder = flat_red("colour-saturated");
    let text = printed(&folder, "info m.npy");
    assert!(text.contains("of the samples behind red are saturated"), "{text}");
}

#[test]
fn luma_is_shown_next_to_counts() {
    let folder = flat_red("colour-side-by-side");
    run(&folder, "restore m.npy -o c.npy --method average --side-by-side s.png");
    // Behind the filter, neighbours in a row of green and red differ; in luma, they do not.
    let picture = image::open(folder.join("s.png")).unwrap().to_luma16();
    let value = |x: u32, y: u32| f64::from(picture.get_pixel(x, y).0[0]) / 65535.0;
    let step = |x: u32, y: u32| (value(x - 1, y) - 2.0 * value(x, y) + value(x + 1, y)).abs();
    let bottom = picture.height() - 20;
    let rough = |y: u32| (10..50).map(|x| step(x, y)).sum::<f64>() / 40.0;
    assert!(rough(bottom).max(rough(bottom + 1)) < 0.4, "{} {}", rough(bottom), rough(bottom + 1));
}

#[test]
fn filters_that_the_record_contradicts_are_warned_of() {
    let folder = exposed("colour-contradiction", "rggb");
    let text = |args: &str| printed(&folder, args);
    let named = text("info m.npy --cfa bggr");
    assert!(named.contains("records the colour filter rggb@0,0, and bggr@0,0 is named"), "{named}");
    let same = text("info m.npy --cfa grbg@0,1");
    assert!(!same.contains("records the colour filter"), "{same}");
    let gray = text("info m.npy --sensor qudi-paper");
    assert!(gray.contains("the named sensor has none"), "{gray}");
}

#[test]
fn converted_captures_keep_tiles_and_say_that_pictures_are_lost() {
    let folder = exposed("colour-convert", "rggb");
    let colours = [[255, 0, 0], [0, 255, 0], [0, 255, 0], [0, 0, 255]];
    let pixel = |x: u32, y: u32| image::Rgb(colours[(y % 2 * 2 + x % 2) as usize]);
    let mut filter = image::RgbImage::from_fn(WIDTH as u32, HEIGHT as u32, pixel);
    filter.save(folder.join("rggb.png")).unwrap();
    printed(&folder, "convert m.npy -o tile.npy --cfa rggb.png --crop 1:64,0:96");
    assert!(run(&folder, "info tile.npy").contains("gbrg@0,0: mean counts red"));
    filter.put_pixel(4, 4, image::Rgb([255; 3]));
    filter.save(folder.join("other.png")).unwrap();
    let text = printed(&folder, "convert m.npy -o picture.npy --cfa other.png");
    assert!(text.contains("does not keep the colour filter other.png"), "{text}");
}

#[test]
fn luma_alone_has_no_misfit_and_colours_have_their_curve() {
    let folder = exposed("colour-luma", "rggb");
    let restore = "restore m.npy --method average";
    let gray = document(&folder, &format!("{restore} -o g.npy --gray --html g.html --json"));
    assert!(gray["results"]["chi_square"].is_null(), "{gray}");
    assert!(!std::fs::read_to_string(folder.join("g.html")).unwrap().contains("misfit"));
    refused(&folder, &format!("{restore} -o h.npy --gray --chi-map c.png"), &["luma", "--chi-map"]);
    refused(&folder, &format!("{restore} -o f --tonemap none"), &["curve of sRGB", "--float"]);
    run(&folder, &format!("{restore} -o c.npy --tonemap none"));
}
