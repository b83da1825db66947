//! Scores flatter nobody: gains, gates, marked frames, the white of clips, frames of other programs.

use crate::support::{npy_bytes, qudi, refused, run, scratch};
use serde_json::Value;
use std::path::Path;

const H: usize = 32;
const W: usize = 40;

/// Image values of a moving texture.
fn value(x: usize, y: usize, t: usize) -> f32 {
    let (x, y) = (x as f32 - 1.5 * t as f32, y as f32);
    0.5 + 0.2 * (x / 2.5).sin() * (y / 3.0).cos() + 0.2 * ((x + 2.0 * y) / 6.0).sin()
}

fn values(frames: usize) -> Vec<f32> {
    let place = |i: usize| (i % W, i / W % H, i / (W * H));
    (0..frames * H * W).map(place).map(|(x, y, t)| value(x, y, t)).collect()
}

fn float_npy(shape: &str, values: impl IntoIterator<Item = f32>) -> Vec<u8> {
    let bytes: Vec<u8> = values.into_iter().flat_map(f32::to_le_bytes).collect();
    npy_bytes("<f4", shape, &bytes)
}

/// Runs an evaluation, and returns its document, what it said, and its exit code.
fn eval(folder: &Path, args: &str) -> (Value, String, i32) {
    let args = format!("eval {args} --json --ppp 9.75");
    let output = qudi(folder).args(args.split_whitespace()).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let document = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
    (document, said, output.status.code().unwrap())
}

fn psnr_a(document: &Value, row: usize) -> f64 {
    document["rows"][row]["psnr_a"]["all"]["mean"].as_f64().unwrap()
}

#[test]
fn black_frames_are_named_and_left_out_and_no_score_is_infinite() {
    let folder = scratch("scoring-black");
    let mut clip = values(6);
    std::fs::write(folder.join("a.npy"), float_npy("(6, 32, 40)", clip.clone())).unwrap();
    let (whole, _, _) = eval(&folder, "a.npy --method mle");
    clip[2 * H * W..3 * H * W].fill(0.0);
    std::fs::write(folder.join("b.npy"), float_npy("(6, 32, 40)", clip)).unwrap();
    let (document, said, code) =
        eval(&folder, "b.npy --method mle,average --min-psnr 90 --csv f.csv");
    assert!(said.contains("black frames of the truth of b (2)"), "{said}");
    assert_eq!(code, 1, "{said}");
    assert!((psnr_a(&document, 0) - psnr_a(&whole, 0)).abs() < 5.0, "{document}");
    assert_eq!(document["rows"][0]["clips"][0]["frames"][2]["mark"], "black");
    let csv = std::fs::read_to_string(folder.join("f.csv")).unwrap();
    assert!(csv.contains("black") && !csv.contains("inf"), "{csv}");
    std::fs::write(folder.join("c.npy"), float_npy("(6, 32, 40)", vec![0.0; 6 * H * W])).unwrap();
    refused(&folder, "eval c.npy --method mle --ppp 3", &["the clip is black", "c.npy"]);
    refused(&folder, "simulate c.npy -o s.npy", &["the clip is black", "c.npy"]);
}

#[test]
fn frames_of_other_programs_say_their_range_and_have_names_of_their_own() {
    let folder = scratch("scoring-external");
    let clip = values(6);
    std::fs::write(folder.join("a.npy"), float_npy("(6, 32, 40)", clip.clone())).unwrap();
    let external = |name: &str, bytes: &[u8]| {
        std::fs::create_dir_all(folder.join(name)).unwrap();
        std::fs::write(folder.join(name).join("a-ppp9_75.npy"), bytes).unwrap();
    };
    external("same", &float_npy("(6, 1, 32, 40)", clip.clone()));
    external("negative", &float_npy("(6, 32, 40, 1)", clip.iter().map(|v| 0.9 - 1.2 * v)));
    external("bytes", &float_npy("(6, 32, 40)", clip.iter().map(|v| 255.0 * v)));
    let args = "a.npy --method mle --external same=same --external negative=negative";
    let (document, said, _) = eval(&folder, args);
    assert_eq!(psnr_a(&document, 1), 100.0);
    assert!(said.contains("frames of same at 9.75 PPP that equal the truth, 6 in all"), "{said}");
    assert!(said.contains("values of negative of a at 9.75 PPP run from"), "{said}");
    // As a black frame, and not as the negative of a good one.
    assert!(psnr_a(&document, 2) < 8.0, "{document}");
    let eval = "eval a.npy --ppp 9.75 --method mle --external";
    refused(&folder, &format!("{eval} bytes=bytes"), &["values from", "255"]);
    refused(&folder, &format!("{eval} average=same"), &["`average` is a method"]);
    refused(&folder, &format!("{eval} x=same --external x=same"), &["`x` comes twice"]);
    // A stack of 16 bits.
    std::fs::create_dir(folder.join("stack")).unwrap();
    let file = std::fs::File::create(folder.join("stack/a-ppp9_75.tif")).unwrap();
    let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
    for frame in clip.chunks(H * W) {
        let samples: Vec<u16> = frame.iter().map(|v| (v * 65535.0) as u16).collect();
        encoder
            .write_image::<tiff::encoder::colortype::Gray16>(W as u32, H as u32, &samples)
            .unwrap();
    }
    drop(encoder);
    run(&folder, "eval a.npy --ppp 9.75 --method mle --external s=stack");
}

#[test]
fn the_white_of_deep_clips_is_asked_for() {
    let folder = scratch("scoring-white");
    let write = |name: &str, full: f32| {
        std::fs::create_dir(folder.join(name)).unwrap();
        for (t, frame) in values(3).chunks(H * W).enumerate() {
            let samples = frame.iter().map(|v| (v * full) as u16).collect();
            let image: image::ImageBuffer<image::Luma<u16>, Vec<u16>> =
                image::ImageBuffer::from_raw(W as u32, H as u32, samples).unwrap();
            image.save(folder.join(name).join(format!("{t}.png"))).unwrap();
        }
    };
    write("twelve", 4095.0);
    write("sixteen", 65535.0);
    refused(&folder, "simulate twelve -o s.npy", &["white 4095"]);
    refused(&folder, "eval twelve --method mle --ppp 3", &["white 4095"]);
    run(&folder, "simulate twelve --white 4095 --seed 1 -o s.npy");
    run(&folder, "simulate sixteen --seed 1 -o t.npy");
    refused(&folder, "simulate scene:text --white 255 -o u.npy", &["white"]);
    let dark: Vec<f32> = values(3).iter().map(|v| v * 0.05).collect();
    std::fs::write(folder.join("dark.npy"), float_npy("(3, 32, 40)", dark)).unwrap();
    let output = qudi(&folder).args("simulate dark.npy -o d.npy".split(' ')).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && said.contains("never exceeds"), "{said}");
}

#[test]
fn every_page_of_a_tiff_is_a_frame_of_its_clip() {
    let folder = scratch("scoring-pages");
    let write = |name: &str, frames: &[f32]| {
        let file = std::fs::File::create(folder.join(name)).unwrap();
        let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
        for frame in frames.chunks(H * W) {
            let samples: Vec<u8> = frame.iter().map(|v| (v * 255.0) as u8).collect();
            encoder
                .write_image::<tiff::encoder::colortype::Gray8>(W as u32, H as u32, &samples)
                .unwrap();
        }
    };
    let clip = values(7);
    write("clip.tif", &clip);
    std::fs::create_dir(folder.join("parts")).unwrap();
    write("parts/a_1.tif", &clip[..3 * H * W]);
    write("parts/a_2.tif", &clip[3 * H * W..4 * H * W]);
    write("parts/a_10.tif", &clip[4 * H * W..]);
    for name in ["clip.tif", "parts"] {
        run(&folder, &format!("simulate {name} --seed 1 -o {name}.npy"));
    }
    let counts = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert!(counts("clip.tif.npy") == counts("parts.npy"), "the same seven frames");
    let record: Value = serde_json::from_slice(&counts("clip.tif.npy.json")).unwrap();
    assert_eq!(record["burst"]["frames"], 7);
    run(&folder, "simulate --from clip.tif.npy.json -o again.npy");
    assert!(counts("again.npy") == counts("clip.tif.npy"));
}

#[test]
fn clips_have_names_of_their_own() {
    let folder = scratch("scoring-names");
    std::fs::create_dir(folder.join("clips")).unwrap();
    for (n, name) in ["x.npy", "x.npy.npy"].iter().enumerate() {
        let clip = values(3).into_iter().map(|v| v / (n + 1) as f32);
        std::fs::write(folder.join("clips").join(name), float_npy("(3, 32, 40)", clip)).unwrap();
    }
    run(&folder, "simulate scene:text --size 32x40 --frames 3 -o s.npy --preview clips/x.gif -q");
    let (document, said, _) = eval(&folder, "clips --method mle");
    let names: Vec<&str> =
        document["clips"].as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect();
    assert_eq!(names, ["x.gif", "x.npy", "x.npy.npy"], "{said}");
}

#[test]
fn options_that_would_not_be_applied_are_refused() {
    let folder = scratch("scoring-unused");
    std::fs::write(folder.join("a.npy"), float_npy("(3, 32, 40)", values(3))).unwrap();
    run(
        &folder,
        "simulate scene:text --size 32x40 --frames 3 --sensor spad512s --ppp 2 -o b.npy -q",
    );
    run(&folder, "simulate scene:text --size 32x40 --frames 3 -o c.npy -q");
    for (args, word) in [
        ("simulate a.npy --speed -1 -o o.npy", "speed"),
        ("simulate a.npy --scene-seed 3 -o o.npy", "scene_seed"),
        ("simulate scene:text --motion pan:1,1 -o o.npy", "motion"),
        ("simulate scene:text --unpacked -o o.npy", "--unpacked"),
        ("convert c.npy --unpacked -o o.npy", "--unpacked"),
        ("restore b.npy --gain 2 --method mle -o o.npy", "--gain"),
        ("demo -o d.jpg", "PNG"),
        ("eval a.npy --method mle --csv a.html", "CSV"),
        ("eval a.npy --method mle --html a.csv", "HTML"),
        ("selftest --device cpu:9", "cpu:9"),
    ] {
        refused(&folder, args, &[word]);
    }
    assert!(!folder.join("o.npy").exists() && !folder.join("a.html").exists());
}
