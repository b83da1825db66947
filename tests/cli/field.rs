//! Real captures without a manual: automatic sums, chosen instants, a first look.

use crate::support::{listing, npy_bytes, qudi, refused, run, scratch};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Creates a folder with `c.npy`: binary frames of a bright square that moves by `speed` pixels a frame.
pub(crate) fn capture(name: &str, frames: usize, rate: f64, speed: f64) -> PathBuf {
    let folder = scratch(name);
    let (height, width) = (32, 48);
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut uniform = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let mut bits = Vec::new();
    for t in 0..frames {
        for i in 0..height * width {
            let (x, y) = ((i % width) as f64 - speed * t as f64, (i / width) as f64);
            let light = 1.0 + 0.8 * (0.6 * x).sin() * (0.5 * y).cos();
            bits.push(u8::from(uniform() < rate * light));
        }
    }
    let packed: Vec<u8> =
        bits.chunks(8).map(|eight| eight.iter().fold(0, |byte, bit| byte << 1 | bit)).collect();
    let shape = format!("({frames}, {height}, {})", width / 8);
    std::fs::write(folder.join("c.npy"), npy_bytes("|u1", &shape, &packed)).unwrap();
    folder
}

pub(crate) fn said(folder: &Path, args: &str) -> String {
    let output = qudi(folder).args(args.split_whitespace()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args}: {text}");
    text
}

#[test]
fn sums_frames_by_itself_and_says_why() {
    let folder = capture("field-sum", 220, 0.05, 0.0);
    let restore = "restore c.npy --sensor swissspad2 --method mle";
    let text = said(&folder, &format!("{restore} -o auto.npy"));
    assert!(text.contains("20 frames are summed into one"), "{text}");
    assert!(text.contains("4885 frames per second") && text.contains("--sum N"), "{text}");
    run(&folder, &format!("{restore} -o twenty.npy --sum 20"));
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert_eq!(read("auto.npy"), read("twenty.npy"));
    let info: Value = serde_json::from_str(&run(&folder, "info c.npy --json")).unwrap();
    assert_eq!((&info["sum"]["frames"], &info["frames"]), (&20.into(), &11.into()));
    let one: Value = serde_json::from_str(&run(&folder, "info c.npy --sum 1 --json")).unwrap();
    assert_eq!((&one["sum"], &one["frames"]), (&Value::Null, &220.into()));
    run(&folder, "convert c.npy -o native.npy");
    let native: Value =
        serde_json::from_str(&run(&folder, "info native.npy --sum 1 --json")).unwrap();
    assert_eq!(native["frames"], 220, "convert keeps frames unless asked");
    refused(&folder, "restore c.npy --sensor swissspad2 -o x.npy --sum 0", &["or auto"]);
    run(&folder, "convert c.npy -o summed.npy --sum auto");
    let summed: Value =
        serde_json::from_str(&run(&folder, "info summed.npy --sum 1 --json")).unwrap();
    assert_eq!((&summed["frames"], &summed["max_count"]), (&11.into(), &20.into()));
    run(&folder, "convert c.npy -o threes.npy --sum 3");
    let threes: Value = serde_json::from_str(&run(&folder, "info threes.npy --json")).unwrap();
    assert_eq!(
        (&threes["frames"], &threes["summed"]),
        (&73.into(), &1.into()),
        "a record settles it"
    );
    refused(&folder, "calibrate c.npy --sensor swissspad2 -o d.toml --sum auto", &["--sum"]);
    std::fs::write(folder.join("deep.npy"), npy_bytes("|u1", "(3, 4, 4)", &[9; 48])).unwrap();
    refused(
        &folder,
        "convert deep.npy -o x.npy --sum auto --pack-axis none",
        &["--sum", "binary frames"],
    );
}

#[test]
fn pedestal_of_a_simulated_camera_is_subtracted_again() {
    let folder = scratch("field-pedestal");
    let simulate = "simulate scene:text --size 32x48 --frames 11 --bits 8 --gain 4 --set sensor.read_noise=0 --seed 3 -o";
    run(&folder, &format!("{simulate} plain.npy"));
    run(&folder, &format!("{simulate} raised.npy --offset 20"));
    let bytes = |name: &str| std::fs::read(folder.join(name)).unwrap();
    let (plain, raised) = (bytes("plain.npy"), bytes("raised.npy"));
    let data = plain.len() - 11 * 32 * 48;
    assert!(plain[data..].iter().zip(&raised[data..]).all(|(a, b)| a.saturating_add(20) == *b));
    run(&folder, "convert raised.npy -o back.npy");
    assert_eq!(bytes("back.npy")[data..], plain[data..]);
}

/// Methods that follow motion restore an evenly moving texture from sums along its motion.
#[test]
fn aligns_sums_by_itself_where_things_move() {
    let folder = capture("field-align", 330, 0.2, 0.15);
    let restore = "restore c.npy --sensor swissspad2 --every 30";
    let text = said(&folder, &format!("{restore} --method qbp -o aligned"));
    assert!(text.contains("motion is followed") && text.contains("aligned along it"), "{text}");
    let manifest = std::fs::read_to_string(folder.join("aligned/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    let aligned = manifest["settings"]["aligned_sums"].as_u64().unwrap();
    assert!((2..=30).contains(&aligned), "{aligned}");
    for other in ["--method mle", "--method qbp --sum 5"] {
        let text = said(&folder, &format!("{restore} {other} -o other.npy -f"));
        assert!(!text.contains("motion is followed"), "{other}: {text}");
    }
    // A light is given per frame as `info` prints it, although the sums that are aligned are shorter.
    let info: Value =
        serde_json::from_str(&run(&folder, "info c.npy --sensor swissspad2 --json")).unwrap();
    let ppp = info["ppp"]["incident"].as_f64().unwrap();
    run(&folder, &format!("{restore} --method qbp -o given --ppp {ppp}"));
    let ppp_of = |name: &str| {
        let manifest = std::fs::read_to_string(folder.join(name).join("manifest.json")).unwrap();
        let manifest: Value = serde_json::from_str(&manifest).unwrap();
        manifest["settings"]["ppp"].as_f64().unwrap()
    };
    let ratio = ppp_of("given") / ppp_of("aligned");
    assert!((ratio - 1.0).abs() < 0.02, "{ratio}");
    // All frames are the same, also when an interrupted run is continued.
    run(&folder, "restore c.npy --sensor swissspad2 --method qbp -o all");
    let pictures = listing(&folder.join("all"));
    let frame = |n: usize| folder.join(format!("all/frame_{n:06}.png"));
    let before = std::fs::read(frame(7)).unwrap();
    for n in 5..pictures.len() - 2 {
        std::fs::remove_file(frame(n)).unwrap();
    }
    run(&folder, "restore c.npy --sensor swissspad2 --method qbp -o all");
    assert_eq!(listing(&folder.join("all")), pictures);
    assert_eq!(std::fs::read(frame(7)).unwrap(), before);
}

/// Frames of a clip are repeated, frames of scenes cannot be; rows of a rolling shutter lag behind.
#[test]
fn clips_repeat_frames_and_rows_roll() {
    let folder = scratch("field-rolling");
    let frames: Vec<u8> = (0..4u8).flat_map(|t| [60 * t + 20; 16 * 20]).collect();
    std::fs::write(folder.join("clip.npy"), npy_bytes("|u1", "(4, 16, 20)", &frames)).unwrap();
    let simulate = "simulate clip.npy --sensor spad-qvga --frames-per-image 3 --seed 1 --ppp 5";
    run(&folder, &format!("{simulate} -o still.npy --truth still-truth.npy"));
    run(&folder, &format!("{simulate} -o rolls.npy --truth rolls-truth.npy --rolling-shutter 1"));
    let info: Value = serde_json::from_str(&run(&folder, "info still.npy --sum 1 --json")).unwrap();
    assert_eq!(info["frames"], 12);
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert_ne!(read("still-truth.npy"), read("rolls-truth.npy"));
    assert_ne!(read("still.npy"), read("rolls.npy"));
    refused(&folder, "simulate scene:text -o s.npy --frames-per-image 3", &["--frames-per-image"]);
    refused(&folder, "simulate clip.npy -o s.npy --rolling-shutter 2", &["rolling_shutter"]);
}

/// Dark rates per second mean the same to binary frames and to a file of their sums.
#[test]
fn rates_per_second_are_those_of_binary_frames() {
    let folder = scratch("field-rates");
    let sensor = "--sensor swissspad2 --set sensor.fps=100000 --set sensor.dark=\"20000/s\"";
    let simulate = "simulate scene:text -o b.npy --frames 70 --size 32x32 --ppp 0.1 --seed 1";
    run(&folder, &format!("{simulate} {sensor}"));
    run(&folder, "convert b.npy -o c.npy --sum 7");
    let rates: Vec<u8> = [20000f32; 32 * 32].iter().flat_map(|rate| rate.to_le_bytes()).collect();
    std::fs::write(folder.join("dcr.npy"), npy_bytes("<f4", "(32, 32)", &rates)).unwrap();
    let options = "--dcr dcr.npy --mask none --method mle";
    run(&folder, &format!("restore b.npy --sum 7 {options} -o from-b.npy"));
    run(&folder, &format!("restore c.npy {options} -o from-c.npy"));
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert_eq!(read("from-b.npy"), read("from-c.npy"));
    let dark = "simulate scene:text -o dark.npy --frames 70 --size 32x32 --ppp 1e-6 --seed 2";
    run(&folder, &format!("{dark} {sensor}"));
    run(&folder, "convert dark.npy -o sums.npy --sum 7");
    let maps = ["dark", "sums"].map(|name| {
        run(&folder, &format!("calibrate {name}.npy -o {name}.toml --hot 30000/s"));
        [read(&format!("{name}.dark.npy")), read(&format!("{name}.bad.npy"))]
    });
    assert!(maps[0] == maps[1], "maps differ");
}

#[test]
fn pictures_of_chosen_instants_are_those_of_all() {
    let folder = capture("field-every", 132, 0.2, 0.0);
    let restore = "restore c.npy --sensor swissspad2 --method mle --sum 3";
    run(&folder, &format!("{restore} -o all"));
    run(&folder, &format!("{restore} -o sixth --every 6"));
    let frame = |run: &str, n: usize| {
        std::fs::read(folder.join(run).join(format!("frame_{n:06}.png"))).unwrap()
    };
    assert_eq!(listing(&folder.join("sixth")).len(), 22 + 1);
    for n in 0..22 {
        assert_eq!(frame("sixth", n), frame("all", 2 * n), "picture {n}");
    }
    // Distant frames, or frames between sums, are each restored from a window of their own.
    run(&folder, &format!("{restore} -o apart --every 33"));
    assert_eq!(listing(&folder.join("apart")).len(), 4 + 1);
    run(&folder, &format!("{restore} -o sliding --every 2 --end 60"));
    assert_eq!(listing(&folder.join("sliding")).len(), 29 + 1);
    let manifest = std::fs::read(folder.join("sliding/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["settings"]["every"], 2);
    assert_eq!(manifest["complete"], true);
    let again = run(&folder, &format!("{restore} -o sliding --every 2 --end 60"));
    assert!(again.contains("29 frames were there already"), "{again}");
    refused(&folder, &format!("{restore} -o sliding --every 4 --end 60"), &["every was 2, now 4"]);
    refused(&folder, &format!("{restore} -o none --every 500"), &["--every"]);
}

#[test]
fn tone_curve_and_rate_apply_to_what_is_written() {
    let folder = capture("field-tone", 77, 0.2, 0.0);
    let restore = "restore c.npy --sensor swissspad2 --method mle --sum 7";
    run(&folder, &format!("{restore} -o linear.npy"));
    run(&folder, &format!("{restore} -o toned.npy --tonemap srgb"));
    let values = |name: &str| -> Vec<f32> {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        let data = &bytes[bytes.len() - 11 * 32 * 48 * 4..];
        data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    };
    for (linear, toned) in values("linear.npy").iter().zip(values("toned.npy")) {
        assert!((qudi_core::linear_to_srgb(linear.max(0.0)) - toned).abs() < 1e-6);
    }
    let played = |fps: &str| {
        let args = format!("{restore} -o - {fps}");
        qudi(&folder).args(args.split_whitespace()).output().unwrap().stdout
    };
    assert!(played("").starts_with(b"YUV4MPEG2 W48 H32 F25:1 "));
    assert!(played("--fps 12.5").starts_with(b"YUV4MPEG2 W48 H32 F12500:1000 "));
    refused(&folder, &format!("{restore} -o x.npy --fps 10"), &["--fps", "does not play"]);
}

#[test]
fn looks_at_a_capture_on_one_page() {
    let folder = capture("field-look", 220, 0.2, 0.0);
    let text = run(&folder, "look c.npy --sensor swissspad2");
    assert!(text.contains("restore    `qudi restore` makes") && text.contains("sum  "), "{text}");
    let page = std::fs::read_to_string(folder.join("c-look.html")).unwrap();
    assert!(page.contains("<svg class=\"timeline\"") && page.contains("counts per pixel"));
    assert!(page.contains("base64,/9j/") && page.contains("c.npy") && page.contains("one instant"));
    // Binary frames are shown without a sensor, too.
    let text = run(&folder, "look c.npy -o look.png");
    assert!(text.contains("restore    not yet: the file does not say which camera"), "{text}");
    assert!(text.contains("name its sensor, as in --sensor"), "{text}");
    let size = image::image_dimensions(folder.join("look.png")).unwrap();
    assert!(size.0 > 2 * 48 && size.1 > 32, "{size:?}");
    refused(&folder, "look c.npy -o look.pdf", &["look.pdf", ".html"]);
    refused(&folder, "look c.npy -o c.npy -f", &["c.npy"]);
}

#[test]
fn looks_at_simulated_binary_frames_with_their_recorded_sensor() {
    let folder = scratch("field-look-record");
    let simulate = "simulate scene:text --sensor swissspad2 --size 64x64 --frames 21 --seed 1 -q";
    run(&folder, &format!("{simulate} -o b.npy"));
    let text = run(&folder, "look b.npy");
    assert!(text.contains("`qudi restore` makes 21 pictures by"), "{text}");
    let page = std::fs::read_to_string(folder.join("b-look.html")).unwrap();
    assert!(page.contains("\"numbers\":[5,") && page.contains("\"total\":21"));
}

#[test]
fn clips_are_exposed_with_sums_and_detections_as_asked() {
    let folder = scratch("field-eval");
    let args = "eval scene:text --method mle --frames 11 --size 48x64 --ppp 4.9 --json";
    let paper = "--sensor spad-qvga --sum 7 --ppp-def detected";
    let row: Value = serde_json::from_str(&run(&folder, &format!("{args} {paper}"))).unwrap();
    assert_eq!(row["sensor"]["frames_summed"], 7);
    assert!(row["rows"][0]["psnr_a"]["all"]["mean"].as_f64().unwrap() > 10.0);
    refused(&folder, &format!("{args} --sum auto"), &["--sum", "--sum 7"]);
}

#[test]
fn pipes_are_converted() {
    let folder = capture("field-pipe", 22, 0.2, 0.0);
    let bytes = std::fs::read(folder.join("c.npy")).unwrap();
    let convert = |args: &str, input: &[u8]| {
        let args = format!("convert - {args} -q");
        qudi(&folder).args(args.split_whitespace()).write_stdin(input).assert().success();
    };
    convert("-o piped.npy", &bytes);
    run(&folder, "convert c.npy -o direct.npy");
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert_eq!(read("piped.npy"), read("direct.npy"));
    convert("-o auto.npy --sum auto", &bytes);
    convert(
        "-o plane.npy --format raw-bits --size 32x48 --cfa rggb --channel 3",
        &bytes[bytes.len() - 22 * 32 * 6..],
    );
    convert("-o raw.npy --format raw-bits --size 32x48", &bytes[bytes.len() - 22 * 32 * 6..]);
    assert_eq!(read("raw.npy"), read("direct.npy"));
}

/// Noise below the pedestal is not cut off: dark parts keep their mean.
#[test]
fn counts_below_the_pedestal_are_signed() {
    let folder = scratch("field-signed");
    let sensor = "base = \"ideal\"\noffset = 100\ngain = 2\nread_noise = 1.5\n";
    std::fs::write(folder.join("s.toml"), sensor).unwrap();
    let (height, width, frames) = (32, 48, 44);
    let light = |x: usize| if x < width / 2 { 0.05 } else { 0.55 };
    let mut state = 7u64;
    let mut uniform = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    };
    let mut bytes = Vec::new();
    for i in 0..frames * height * width {
        let (mut electrons, mut product) = (0.0, uniform());
        while product > f64::exp(-light(i % width)) {
            product *= uniform();
            electrons += 1.0;
        }
        let noise = (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
        let value = (100.0 + 2.0 * (electrons + 1.5 * noise)).round();
        bytes.extend((value as u16).to_le_bytes());
    }
    let array = npy_bytes("<u2", "(44, 32, 48)", &bytes);
    std::fs::write(folder.join("c.npy"), array).unwrap();
    let args =
        "restore c.npy --sensor s.toml --method mle --ppp 1 --exposure 1 --mask none -o o.npy";
    run(&folder, args);
    let npy = std::fs::read(folder.join("o.npy")).unwrap();
    let values = npy[npy.len() - 4 * bytes.len() / 2..].chunks_exact(4);
    let mut sums = [0.0; 2];
    for (i, value) in values.enumerate() {
        let value = f64::from(f32::from_le_bytes(value.try_into().unwrap()));
        sums[i % width * 2 / width] += value / (frames * height * width / 2) as f64;
    }
    assert!((sums[0] - 0.05).abs() < 0.03 && (sums[1] - 0.55).abs() < 0.03, "{sums:?}");
}

/// Two scenes one after the other are restored as each of them alone.
#[test]
fn nothing_reaches_over_a_cut() {
    let folder = capture("field-cut", 220, 0.2, 0.0);
    let one = std::fs::read(folder.join("c.npy")).unwrap();
    let frames = &one[one.len() - 220 * 32 * 6..];
    // The other scene has half of the light on its right half.
    let other = frames.iter().enumerate();
    let other: Vec<u8> =
        other.map(|(i, &byte)| if i % 6 < 3 { byte } else { byte & 0x55 }).collect();
    let both = [frames, &other].concat();
    std::fs::write(folder.join("both.npy"), npy_bytes("|u1", "(440, 32, 6)", &both)).unwrap();
    let restore = "restore both.npy --sensor swissspad2 --ppp 1 --exposure 0.4 --mask none";
    let values = |name: &str| {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        bytes[bytes.iter().position(|&byte| byte == b'\n').unwrap() + 1..].to_vec()
    };
    for options in
        ["--sum 7 --method average", "--sum 7 --method qbp --every 2", "--sum 3 --every 8"]
    {
        let run_part = |name: &str, part: &str| {
            run(&folder, &format!("{restore} {options} {part} -o {name}.npy -f"));
            values(&format!("{name}.npy"))
        };
        let parts = [run_part("before", "--end 220"), run_part("after", "--start 220")].concat();
        assert!(run_part("whole", "") == parts, "{options}");
    }
    let text = said(&folder, &format!("{restore} --method average -o frames"));
    assert!(text.contains("cuts to another scene at frames: 220"), "{text}");
    let manifest = std::fs::read_to_string(folder.join("frames/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["settings"]["parts"], serde_json::json!([[0, 220], [220, 440]]));
    assert_eq!(manifest["results"]["findings"]["cuts"], serde_json::json!([220]));
    // A run that was interrupted goes on to the same pictures, and the same chi-square.
    let chi_square = |manifest: &Value| manifest["results"]["chi_square"].as_f64().unwrap();
    let pictures = listing(&folder.join("frames"));
    let middle = format!("frame_{:06}.png", pictures.len() / 2);
    std::fs::remove_file(folder.join("frames").join(middle)).unwrap();
    run(&folder, &format!("{restore} --method average -o frames"));
    let again = std::fs::read_to_string(folder.join("frames/manifest.json")).unwrap();
    let again: Value = serde_json::from_str(&again).unwrap();
    assert_eq!(chi_square(&again), chi_square(&manifest));
    let page = run(&folder, "look both.npy --sensor swissspad2 --json");
    let page: Value = serde_json::from_str(&page).unwrap();
    assert_eq!(page["findings"]["cuts"], serde_json::json!([220]));
    let page = std::fs::read_to_string(folder.join("both-look.html")).unwrap();
    assert!(page.contains("<title>cut: frame 220</title>"));
}

/// Missing numbers end a part, unless they hardly matter.
#[test]
fn nothing_reaches_over_missing_frames() {
    let folder = scratch("field-gap");
    let scene = "simulate scene:text --size 32x48 --frames 30 --ppp 3 --seed 3 --speed 1";
    run(&folder, &format!("{scene} -o all"));
    let place = folder.join("all");
    for number in 9..14 {
        std::fs::remove_file(place.join(format!("frame_{number:06}.png"))).unwrap();
    }
    std::fs::remove_file(place.join("burst.json")).unwrap();
    let restore =
        "restore all --sensor qudi-paper --bits 3 --gain 1.077 --ppp 3 --exposure 0.4 --mask none";
    let values = |name: &str| {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        bytes[bytes.iter().position(|&byte| byte == b'\n').unwrap() + 1..].to_vec()
    };
    for method in ["average", "qbp"] {
        let run_part = |name: &str, part: &str| {
            run(&folder, &format!("{restore} --method {method} {part} -o {name}.npy -f"));
            values(&format!("{name}.npy"))
        };
        let parts = [run_part("before", "--end 9"), run_part("after", "--start 9")].concat();
        assert!(run_part("whole", "") == parts, "{method}");
    }
    let text = said(&folder, &format!("{restore} --method average -o frames"));
    assert!(text.contains("numbers 9 to 13 are missing"), "{text}");
    let manifest = std::fs::read_to_string(folder.join("frames/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["settings"]["parts"], serde_json::json!([[0, 9], [9, 25]]));
    assert_eq!(manifest["results"]["findings"]["missing"], serde_json::json!([9]));
}

/// Noise about the pedestal of a simulated camera is drawn, kept by `convert`, and restored without bias.
#[test]
fn noise_below_the_pedestal_is_simulated() {
    let folder = scratch("field-simulated-noise");
    let sensor = "base = \"ideal\"\nbits = 12\ngain = 2\nread_noise = 1.5\n";
    std::fs::write(folder.join("plain.toml"), sensor).unwrap();
    let dark =
        "simulate scene:text --size 32x48 --frames 44 --ppp 0.05 --seed 3 --sensor plain.toml";
    run(&folder, &format!("{dark} --offset 100 -o c.npy"));
    let bytes = std::fs::read(folder.join("c.npy")).unwrap();
    let counts = bytes[bytes.len() - 2 * 44 * 32 * 48..].chunks_exact(2);
    let counts = counts.map(|count| f64::from(u16::from_le_bytes([count[0], count[1]])));
    let (sum, below) = counts
        .fold((0.0, 0), |(sum, below), count| (sum + count, below + usize::from(count < 100.0)));
    let pixels = (44 * 32 * 48) as f64;
    // 0.1 DN of light above the pedestal, and a standard error of 0.012.
    assert!((sum / pixels - 100.1).abs() < 0.05, "{}", sum / pixels);
    assert!(below as f64 > 0.35 * pixels, "{below}");
    run(&folder, "convert c.npy -o d.tif");
    let mean = |capture: &str| {
        let args =
            format!("restore {capture} --method mle --ppp 1 --exposure 1 --mask none -o o.npy -f");
        run(&folder, &args);
        let npy = std::fs::read(folder.join("o.npy")).unwrap();
        let values = npy[npy.len() - 4 * 44 * 32 * 48..].chunks_exact(4);
        let values = values.map(|v| f64::from(f32::from_le_bytes([v[0], v[1], v[2], v[3]])));
        values.sum::<f64>() / pixels
    };
    for capture in ["c.npy", "d.tif"] {
        let mean = mean(capture);
        assert!((mean - 0.05).abs() < 0.025, "{capture}: {mean}");
    }
    let info: Value = serde_json::from_str(&run(&folder, "info d.tif --json")).unwrap();
    let light = info["ppp"]["incident"].as_f64().unwrap();
    assert!((light - 0.05).abs() < 0.025, "{light}");
    // Methods are compared without the pedestal, too.
    let score = |sensor: &str| {
        let args = format!(
            "eval scene:text --size 32x48 --frames 11 --ppp 3 --method mle --json {sensor}"
        );
        let scores: Value = serde_json::from_str(&run(&folder, &args)).unwrap();
        scores.to_string()
    };
    std::fs::write(folder.join("raised.toml"), format!("{sensor}offset = 100\n")).unwrap();
    let (plain, raised) = (score("--sensor plain.toml"), score("--sensor raised.toml"));
    let psnr = |text: &str| {
        let at = text.find("\"psnr\"").unwrap_or_else(|| panic!("{text}"));
        text[at + 7..].split([',', '}']).next().unwrap().parse::<f64>().unwrap()
    };
    assert!((psnr(&plain) - psnr(&raised)).abs() < 1.0, "{plain}\n{raised}");
}

/// A converted capture keeps its sensor and its light.
#[test]
fn conversions_keep_the_sensor() {
    let folder = scratch("field-converted");
    let simulate =
        "simulate scene:text --size 32x48 --frames 40 --sensor swissspad2 --ppp 0.5 --seed 2";
    run(&folder, &format!("{simulate} -o c.npy"));
    run(&folder, "convert c.npy -o d.npy --sum 4");
    let info = |args: &str| serde_json::from_str::<Value>(&run(&folder, args)).unwrap();
    let (summed, converted) = (info("info c.npy --sum 4 --json"), info("info d.npy --json"));
    for key in ["ppp", "mean", "max_count"] {
        assert_eq!(converted[key], summed[key], "{key}");
    }
    let of = |name: &str, args: &str| {
        run(&folder, &format!("restore {args} --method mle -o {name}"));
        std::fs::read(folder.join(name)).unwrap()
    };
    assert!(of("one.npy", "c.npy --sum 4") == of("two.npy", "d.npy"));
}

#[test]
fn calibration_warns_of_a_picture_in_a_dark_capture() {
    let folder = capture("field-dark", 200, 0.2, 0.0);
    let text = said(&folder, "calibrate c.npy --sensor swissspad2 -o lit.toml");
    assert!(text.contains("the capture shows a picture"), "{text}");
    let mut state = 3_u64;
    let mut byte = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 56) as u8
    };
    let dark: Vec<u8> = (0..200 * 32 * 6).map(|_| byte() & byte() & byte()).collect();
    std::fs::write(folder.join("d.npy"), npy_bytes("|u1", "(200, 32, 6)", &dark)).unwrap();
    let text = said(&folder, "calibrate d.npy --sensor swissspad2 -o dark.toml");
    assert!(!text.contains("picture"), "{text}");
}

/// A pedestal that nobody names is told from dark counts, and from then on subtracted.
#[test]
fn calibration_finds_the_pedestal() {
    let folder = scratch("field-pedestal-found");
    let mut state = 5_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    // Sums of twelve uniform numbers are nearly normal.
    let values = (0..30 * 32 * 48).map(|_| {
        let normal: f64 = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        (100.0 + 2.0 * 1.5 * normal).round() as u16
    });
    let bytes: Vec<u8> = values.flat_map(u16::to_le_bytes).collect();
    std::fs::write(folder.join("d.npy"), npy_bytes("<u2", "(30, 32, 48)", &bytes)).unwrap();
    for (name, options) in [("found", ""), ("given", "--offset 100")] {
        let calibrate = format!("calibrate d.npy --sensor ideal --gain 2 -o {name}.toml {options}");
        let found: Value = serde_json::from_str(&run(&folder, &(calibrate + " --json"))).unwrap();
        let number = |key: &str| found[key].as_f64().unwrap();
        assert!((number("offset") - 100.0).abs() < 0.2, "{found}");
        assert!(number("dark_per_frame") < 0.05 && number("hot_pixels") < 3.0, "{found}");
        assert!((number("read_noise") - 1.5).abs() < 0.1, "{found}");
        let sensor = std::fs::read_to_string(folder.join(format!("{name}.toml"))).unwrap();
        assert!(sensor.contains("offset = "), "{sensor}");
    }
}
