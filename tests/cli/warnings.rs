//! Warnings of what makes a result doubtful.

use crate::field::{capture, said};
use crate::support::{npy_bytes, run, scratch};
use serde_json::Value;

#[test]
fn warns_of_mosaics() {
    let folder = scratch("field-mosaic");
    let (height, width, frames) = (128, 160, 40);
    let mut state = 1_u64;
    let mut counts = Vec::new();
    for i in 0..frames * height * width {
        let (x, y) = (i % width, i / width % height);
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let filter = [[8, 5], [5, 3]][y % 2][x % 2];
        counts.push((filter + (state >> 62)) as u8);
    }
    let shape = format!("({frames}, {height}, {width})");
    std::fs::write(folder.join("m.npy"), npy_bytes("|u1", &shape, &counts)).unwrap();
    let text = run(&folder, "info m.npy --bits 4");
    assert!(text.contains("--cfa rggb or bggr"), "{text}");
    let text = run(&folder, "info m.npy --bits 4 --cfa rggb --channel 0");
    assert!(!text.contains("colour filter array: name it"), "{text}");
}

#[test]
fn warns_of_what_makes_a_result_doubtful() {
    let folder = capture("field-warn", 77, 0.2, 0.0);
    let ones = npy_bytes("|u1", "(22, 16, 2)", &[0xff; 22 * 16 * 2]);
    std::fs::write(folder.join("ones.npy"), ones).unwrap();
    let info: Value =
        serde_json::from_str(&run(&folder, "info ones.npy --pack-axis width --json")).unwrap();
    assert!(info["warnings"][0].as_str().unwrap().contains("saturated"), "{info}");
    // Means of frames vary less than counts.
    let even = npy_bytes("|u1", "(22, 16, 16)", &[3; 22 * 16 * 16]);
    std::fs::write(folder.join("even.npy"), even).unwrap();
    let args = "restore even.npy --bits 3 --sensor swissspad2 --method mle -o even";
    let text = said(&folder, args);
    assert!(text.contains("warning: chi-square is") && text.contains("averaged"), "{text}");
    let manifest = std::fs::read(folder.join("even/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    let warnings = manifest["results"]["warnings"].as_array().unwrap();
    assert!(warnings.iter().any(|w| w.as_str().unwrap().contains("chi-square")), "{manifest}");
}

#[test]
fn default_method_says_why_it_is_not_the_network() {
    let folder = capture("field-dim", 120, 0.005, 0.0);
    let text = said(&folder, "restore c.npy --sensor swissspad2 --sum 5 -o dim.npy");
    assert!(text.contains("detections per pixel and frame; the weights were trained"), "{text}");
    assert!(text.contains("restoring by qbp-refined"), "{text}");
}

#[test]
fn saturated_samples_are_warned_of_where_the_sensor_knows_full_scale() {
    let folder = scratch("field-saturated");
    let counts = npy_bytes("|u1", "(4, 64, 64)", &[7; 4 * 64 * 64]);
    std::fs::write(folder.join("c.npy"), counts).unwrap();
    let text = said(&folder, "restore c.npy --sensor qudi-paper --ppp 26 --method mle -o o.npy");
    assert!(text.contains("100.0 % of the samples are saturated"), "{text}");
    assert!(!text.contains("vary less"), "{text}");
}

#[test]
fn warns_of_the_other_bit_order() {
    let folder = scratch("warnings-bits");
    let simulate = "simulate scene:dead-leaves -o c.npy --sensor swissspad2 --seed 1 --frames 400";
    run(&folder, &format!("{simulate} --ppp 0.5 --size 128x192"));
    std::fs::remove_file(folder.join("c.npy.json")).unwrap();
    let args = "restore c.npy --pack-axis width --sensor swissspad2 --sum 50 --method mle --force -o o.npy";
    assert!(!said(&folder, args).contains("--bitorder"));
    let text = said(&folder, &format!("{args} --bitorder lsb"));
    assert!(text.contains("stored MSB first: see --bitorder"), "{text}");
}

#[test]
fn warns_of_frames_along_another_axis() {
    let folder = scratch("warnings-axes");
    let (height, width, frames) = (48, 40, 60);
    let mut state = 3_u64;
    let mut counts = Vec::new();
    for i in 0..height * width * frames {
        let (x, y) = ((i / frames % width) as f64, (i / (frames * width)) as f64);
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let light = 3.0 + (0.3 * x + 0.1 * y + 0.01 * (i % frames) as f64).sin() + (0.2 * y).cos();
        counts.push((light + (state >> 61) as f64 / 4.0) as u8);
    }
    let shape = format!("({height}, {width}, {frames})");
    std::fs::write(folder.join("c.npy"), npy_bytes("|u1", &shape, &counts)).unwrap();
    let text = run(&folder, "info c.npy --bits 3");
    assert!(text.contains("along another axis") && text.contains("--axes hwt"), "{text}");
    let text = run(&folder, "info c.npy --bits 3 --axes hwt");
    assert!(!text.contains("along another axis"), "{text}");
}
