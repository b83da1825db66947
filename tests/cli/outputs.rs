//! Outputs of `qudi simulate`: formats, records, truth, flow, reproducibility.

use crate::support::{listing, npy_bytes, qudi, scratch};
use assert_cmd::Command;
use std::path::Path;

/// Reads header text and data of a `.npy` file.
fn npy(path: &Path) -> (String, Vec<u8>) {
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    (String::from_utf8(bytes[10..start].to_vec()).unwrap(), bytes[start..].to_vec())
}

fn simulate(folder: &Path, args: &str) {
    qudi(folder).arg("simulate").args(args.split_whitespace()).assert().success();
}

#[test]
fn packs_binary_bursts_along_the_width_first_pixel_highest() {
    let folder = scratch("packed");
    simulate(
        &folder,
        "scene:chart --size 10x13 --frames 5 --sensor spad512s --ppp 2 --seed 3 -o packed.npy",
    );
    simulate(
        &folder,
        "scene:chart --size 10x13 --frames 5 --sensor spad512s --ppp 2 --seed 3 -o plain.npy --unpacked",
    );
    let (header, packed) = npy(&folder.join("packed.npy"));
    assert!(header.contains("'|u1'") && header.contains("(5, 10, 2)"), "{header}");
    let (header, plain) = npy(&folder.join("plain.npy"));
    assert!(header.contains("(5, 10, 13)"), "{header}");
    for (row, bytes) in plain.chunks(13).zip(packed.chunks(2)) {
        for (x, &pixel) in row.iter().enumerate() {
            assert_eq!(bytes[x / 8] >> (7 - x % 8) & 1, pixel);
        }
        assert_eq!(bytes[1] & 0b111, 0, "padding bits are 0");
    }
    assert!(plain.contains(&1) && plain.contains(&0));
}

#[test]
fn every_format_holds_the_same_counts() {
    let folder = scratch("formats");
    for output in ["a.npy", "a.tif", "a"] {
        simulate(
            &folder,
            &format!("scene:text --size 24x32 --frames 3 --ppp 9.75 --seed 5 -o {output}"),
        );
    }
    simulate(
        &folder,
        "scene:text --size 24x32 --frames 3 --sensor qis16-gj --ppp 400 --seed 5 -o deep.npy",
    );
    let (_, counts) = npy(&folder.join("a.npy"));
    for (t, expected) in counts.chunks(24 * 32).enumerate() {
        let png = image::open(folder.join(format!("a/frame_00000{t}.png"))).unwrap();
        assert_eq!(png.into_luma8().into_raw(), expected);
    }
    let tiff = std::fs::File::open(folder.join("a.tif")).unwrap();
    let mut tiff = tiff::decoder::Decoder::new(tiff).unwrap();
    for (t, expected) in counts.chunks(24 * 32).enumerate() {
        let tiff::decoder::DecodingResult::U8(page) = tiff.read_image().unwrap() else {
            panic!("8-bit pages")
        };
        assert_eq!(page, expected);
        assert_eq!(tiff.more_images(), t < 2);
        if tiff.more_images() {
            tiff.next_image().unwrap();
        }
    }
    let (header, deep) = npy(&folder.join("deep.npy"));
    assert!(header.contains("'<u2'"), "{header}");
    let brightest = deep.chunks(2).map(|b| u16::from_le_bytes([b[0], b[1]])).max().unwrap();
    assert!(brightest > 255 && brightest < 4096, "{brightest}");
    assert_eq!(
        listing(&folder),
        ["a", "a.npy", "a.npy.json", "a.tif", "a.tif.json", "deep.npy", "deep.npy.json"]
    );
}

#[test]
fn force_replaces_own_files_and_folders() {
    let folder = scratch("force");
    for output in ["a.npy", "a"] {
        simulate(&folder, &format!("scene:text --size 16x16 --frames 5 --seed 1 -o {output}"));
        simulate(
            &folder,
            &format!("scene:text --size 16x16 --frames 2 --seed 1 -o {output} --force"),
        );
    }
    assert_eq!(listing(&folder), ["a", "a.npy", "a.npy.json"]);
    assert_eq!(listing(&folder.join("a")), ["burst.json", "frame_000000.png", "frame_000001.png"]);
    assert!(npy(&folder.join("a.npy")).0.contains("(2, 16, 16)"));
}

#[test]
fn record_reproduces_its_burst_from_any_folder() {
    let folder = scratch("record");
    simulate(
        &folder,
        "scene:dead-leaves --size 40x56 --frames 4 --sensor swissspad2 --sum 7 --set sensor.defects.crosstalk=0.02 --set sensor.defects.afterpulse=0.01 --ppp 60 --instants 3 -o first.npy",
    );
    let elsewhere = scratch("record-elsewhere");
    let record = folder.join("first.npy.json");
    qudi(&elsewhere)
        .args(["simulate", "-j", "1", "-o", "again.npy", "--from"])
        .arg(&record)
        .assert()
        .success();
    assert_eq!(
        std::fs::read(folder.join("first.npy")).unwrap(),
        std::fs::read(elsewhere.join("again.npy")).unwrap()
    );
    let refused = qudi(&elsewhere)
        .args(["simulate", "--ppp", "3", "-o", "x.npy", "--from"])
        .arg(&record)
        .assert()
        .code(2);
    assert!(String::from_utf8_lossy(&refused.get_output().stderr).contains("--ppp with --from"));
}

#[test]
fn truth_flow_preview_and_visionsim_files_lie_beside_the_burst() {
    let folder = scratch("beside");
    simulate(
        &folder,
        "scene:chart --size 20x30 --frames 4 --sensor spad512s --seed 1 -o frames.npy --truth truth.npy --flow flow.npy --preview look.gif --visionsim",
    );
    simulate(
        &folder,
        "scene:chart --size 20x30 --frames 4 --sensor spad512s --seed 1 -o counts --truth truth",
    );
    let (header, truth) = npy(&folder.join("truth.npy"));
    assert!(header.contains("'<f4'") && header.contains("(4, 20, 30)"), "{header}");
    let first = f32::from_le_bytes([truth[0], truth[1], truth[2], truth[3]]);
    let png = image::open(folder.join("truth/frame_000000.png")).unwrap().into_luma16();
    assert!((f32::from(png.into_raw()[0]) / 65535.0 - first).abs() < 1e-4);
    let (header, _) = npy(&folder.join("flow.npy"));
    assert!(header.contains("(3, 3, 20, 30)"), "{header}");
    let transforms: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("transforms.json")).unwrap()).unwrap();
    assert_eq!(transforms["bitpack_dim"], 2);
    assert_eq!(transforms["frames"].as_array().unwrap().len(), 4);
    assert_eq!(&std::fs::read(folder.join("look.gif")).unwrap()[..6], b"GIF89a");
}

/// Frames written as PNG, GIF, Y4M and .npy are the same scene, so they give the same photons.
#[test]
fn every_input_format_shows_the_same_scene() {
    let folder = scratch("inputs");
    simulate(
        &folder,
        "scene:dead-leaves --size 24x32 --frames 3 --seed 1 -o counts.npy --truth truth",
    );
    // One 8-bit version of the scene for all formats.
    let mut frames = Vec::new();
    std::fs::create_dir(folder.join("png")).unwrap();
    std::fs::create_dir(folder.join("tiff")).unwrap();
    for t in 0..3 {
        let frame =
            image::open(folder.join(format!("truth/frame_00000{t}.png"))).unwrap().into_luma8();
        frame.save(folder.join(format!("png/{t}.png"))).unwrap();
        frame.save(folder.join(format!("tiff/{t}.tif"))).unwrap();
        frames.push(frame);
    }
    let mut y4m = b"YUV4MPEG2 W32 H24 F30:1 Cmono XCOLORRANGE=FULL\n".to_vec();
    let mut samples = Vec::new();
    let gif = std::fs::File::create(folder.join("clip.gif")).unwrap();
    let palette: Vec<u8> = (0..=255).flat_map(|v| [v, v, v]).collect();
    let mut gif = gif::Encoder::new(gif, 32, 24, &palette).unwrap();
    for frame in &frames {
        y4m.extend(b"FRAME\n");
        y4m.extend(frame.as_raw());
        samples.extend(frame.as_raw());
        gif.write_frame(&gif::Frame::from_indexed_pixels(32, 24, frame.as_raw().clone(), None))
            .unwrap();
    }
    drop(gif);
    std::fs::write(folder.join("clip.y4m"), &y4m).unwrap();
    std::fs::write(folder.join("clip.npy"), npy_bytes("|u1", "(3, 24, 32)", &samples)).unwrap();

    let crc = |output: &str| {
        let record: serde_json::Value =
            serde_json::from_slice(&std::fs::read(folder.join(output)).unwrap()).unwrap();
        record["clip"]["crc32"].as_u64().unwrap()
    };
    simulate(&folder, "png --seed 1 -o from-png.npy");
    let expected = std::fs::read(folder.join("from-png.npy")).unwrap();
    for input in ["tiff", "clip.gif", "clip.y4m", "clip.npy"] {
        simulate(&folder, &format!("{input} --seed 1 -o out.npy --force"));
        // Gray from R, G, B rounds in the last bit, so photons are compared where light is equal.
        if input != "clip.gif" {
            assert_eq!(crc("out.npy.json"), crc("from-png.npy.json"), "{input}");
            assert_eq!(std::fs::read(folder.join("out.npy")).unwrap(), expected, "{input}");
        }
    }
    let piped = qudi(&folder)
        .args(["simulate", "-", "--seed", "1", "-o", "-"])
        .write_stdin(y4m)
        .assert()
        .success();
    assert_eq!(piped.get_output().stdout, expected, "a pipe in and a pipe out");
}

#[test]
fn still_moves_as_specified() {
    let folder = scratch("still");
    simulate(&folder, "scene:chart --size 48x64 --frames 1 --seed 1 -o c.npy --truth still");
    simulate(
        &folder,
        "still/frame_000000.png --motion pan:3,-2+layers:2 --frames 3 --seed 1 -o moving.npy --flow flow.npy --truth moving",
    );
    let (header, flow) = npy(&folder.join("flow.npy"));
    assert!(header.contains("(2, 3, 48, 64)"), "{header}");
    let value = |i: usize| {
        f32::from_le_bytes([flow[4 * i], flow[4 * i + 1], flow[4 * i + 2], flow[4 * i + 3]])
    };
    let panned = (0..48 * 64).filter(|&i| (value(i) - 3.0).abs() < 1e-4).count();
    assert!(
        panned > 48 * 64 / 2 && panned < 48 * 64,
        "{panned} pixels follow the pan, the cut-outs do not"
    );
}

#[test]
fn uses_dark_map_beside_the_sensor_file() {
    let folder = scratch("dark-map");
    std::fs::create_dir(folder.join("lab")).unwrap();
    // Three dark electrons in the left half, none in the right.
    let rates: Vec<u8> =
        (0..2000).flat_map(|i| if i % 50 < 25 { 3.0f32 } else { 0.0 }.to_le_bytes()).collect();
    let map = npy_bytes("<f4", "(40, 50)", &rates);
    std::fs::write(folder.join("lab/dcr.npy"), map).unwrap();
    std::fs::write(
        folder.join("lab/s.toml"),
        "base = \"ideal\"\nbits = 8\n[defects]\ndark_map = \"dcr.npy\"\n",
    )
    .unwrap();
    simulate(
        &folder,
        "scene:text --size 40x50 --frames 40 --sensor lab/s.toml --ppp 0 --seed 1 -o dark.npy",
    );
    let (_, counts) = npy(&folder.join("dark.npy"));
    let sums = counts.chunks(50).fold([0u64; 2], |[left, right], row| {
        let sum = |half: &[u8]| half.iter().map(|&c| u64::from(c)).sum::<u64>();
        [left + sum(&row[..25]), right + sum(&row[25..])]
    });
    // Poisson sum of 40,000 pixels of mean 3, within five deviations.
    assert!(sums[0].abs_diff(120_000) < 1733 && sums[1] == 0, "{sums:?}");
    let refused = qudi(&folder)
        .args("simulate scene:text --size 40x51 --sensor lab/s.toml -o x.npy".split(' '))
        .assert()
        .code(2);
    assert!(
        String::from_utf8_lossy(&refused.get_output().stderr)
            .contains("a dark map of 40 x 50 for frames of 40 x 51")
    );
}

/// An imitation of ffmpeg on PATH delivers frames, or fails half-way.
#[cfg(unix)]
#[test]
fn reads_videos_through_ffmpeg() {
    let folder = scratch("video");
    let mut frames = Vec::new();
    for t in 0..3u8 {
        frames.extend(b"P6\n16 8\n255\n");
        frames.extend((0..16 * 8 * 3).map(|i| (i as u8).wrapping_mul(t + 1)));
    }
    std::fs::write(folder.join("frames.ppm"), &frames).unwrap();
    std::fs::write(folder.join("clip.mp4"), "stands for a video").unwrap();
    let run = |script: &str, output: &str| {
        // Written by another process: a file that this one has open for writing may still be open in
        // the children of other tests, and could then not be run.
        Command::new("sh")
            .args(["-c", "cat > ffmpeg && chmod 755 ffmpeg"])
            .current_dir(&folder)
            .write_stdin(format!("#!/bin/sh\n{script}\n"))
            .assert()
            .success();
        let path = format!("{}:/usr/bin:/bin", folder.display());
        qudi(&folder)
            .args(["simulate", "clip.mp4", "--seed", "1", "-o", output])
            .env("PATH", path)
            .output()
            .unwrap()
    };
    let output = run("cat frames.ppm", "out.npy");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (header, _) = npy(&folder.join("out.npy"));
    assert!(header.contains("(3, 8, 16)"), "{header}");
    for (script, reason) in [
        ("cat frames.ppm; echo 'moov atom not found' >&2; exit 1", "moov atom not found"),
        ("head -c 500 frames.ppm", "ends inside a frame"),
        ("exit 0", "no video frames in it"),
    ] {
        let output = run(script, "bad.npy");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(reason), "{said}");
        assert!(!folder.join("bad.npy").exists());
    }
}

#[test]
fn films_say_what_their_colours_are() {
    let folder = scratch("film-tags");
    simulate(&folder, "scene:dead-leaves --size 33x48 --frames 3 --seed 1 -o m.npy");
    // An imitation of ffmpeg keeps its arguments and writes a file.
    let script = "#!/bin/sh\ncat > /dev/null\necho \"$@\" > words\nfor last; do :; done\necho film > \"${last#file:}\"\n";
    Command::new("sh")
        .args(["-c", "cat > ffmpeg && chmod 755 ffmpeg"])
        .current_dir(&folder)
        .write_stdin(script)
        .assert()
        .success();
    let path = format!("{}:/usr/bin:/bin", folder.display());
    let restore = ["restore", "m.npy", "--method", "average", "-o", "film.mp4"];
    qudi(&folder).args(restore).env("PATH", path).assert().success();
    let words = std::fs::read_to_string(folder.join("words")).unwrap();
    for tag in ["out_color_matrix=bt709", "-colorspace bt709", "-color_range tv", "iec61966-2-1"] {
        assert!(words.contains(tag), "{tag}: {words}");
    }
}

#[test]
fn settings_come_in_layers() {
    let folder = scratch("layers");
    std::fs::write(
        folder.join("my.toml"),
        "[simulate]\nppp = 5\nseed = 9\n[sensor]\nread_noise = 0.4\n",
    )
    .unwrap();
    std::fs::write(
        folder.join("sensor.toml"),
        "base = \"spad-qvga\"\nname = \"mine\"\ndark = \"100/s\"\n",
    )
    .unwrap();
    let shown = |args: &[&str], key: &str| {
        let output = qudi(&folder)
            .args(["config", "show", "--json"])
            .args(args)
            .env("QUDI_SIMULATE_PPP", "6")
            .output()
            .unwrap();
        let keys: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        keys.as_array().unwrap().iter().find(|k| k["key"] == key).unwrap().clone()
    };
    assert_eq!(shown(&[], "simulate.instants")["origin"], "default");
    assert_eq!(shown(&["-c", "my.toml"], "simulate.seed")["origin"], "my.toml");
    assert_eq!(shown(&["-c", "my.toml"], "simulate.ppp")["origin"], "QUDI_SIMULATE_PPP");
    assert_eq!(shown(&["--set", "simulate.ppp=7"], "simulate.ppp")["origin"], "--set");
    let output = qudi(&folder)
        .args("simulate scene:text --size 16x16 --json -o a.npy -c my.toml --set simulate.ppp=7 --ppp 8".split(' '))
        .env("QUDI_SIMULATE_PPP", "6")
        .output()
        .unwrap();
    let record: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(record["simulation"]["ppp"], 8.0);
    assert_eq!(record["simulation"]["seed"], 9);
    assert_eq!(record["simulation"]["sensor"]["read_noise"], 0.4);
    let output = qudi(&folder)
        .args("simulate scene:text --size 16x16 --json -o b.npy --sensor sensor.toml".split(' '))
        .output()
        .unwrap();
    let record: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let sensor = &record["simulation"]["sensor"];
    assert_eq!((sensor["name"].as_str(), sensor["dark"].as_str()), (Some("mine"), Some("100/s")));
    assert_eq!(sensor["quantum_efficiency"], 0.106, "the rest comes from the preset");
}

#[test]
fn writes_completions_and_manual() {
    let folder = scratch("man");
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = qudi(&folder).args(["completions", shell]).output().unwrap();
        assert!(String::from_utf8_lossy(&script.stdout).contains("simulate"), "{shell}");
    }
    qudi(&folder).args(["man", "pages"]).assert().success();
    assert!(listing(&folder.join("pages")).contains(&"qudi-simulate.1".to_owned()));
    let scripts = listing(&folder.join("pages/completions"));
    assert_eq!(scripts, ["_qudi", "_qudi.ps1", "qudi.bash", "qudi.elv", "qudi.fish"]);
}
