//! `qudi restore`: outputs agree, interrupted runs continue, shards complete each other, settings do not mix.

use crate::support::{listing, qudi, scratch};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

fn burst(name: &str, frames: u32) -> PathBuf {
    let folder = scratch(name);
    qudi(&folder)
        .args("simulate scene:dead-leaves --size 64x80 --ppp 9.75 --seed 3 -o b.npy -q".split(' '))
        .args(["--frames", &frames.to_string()])
        .assert()
        .success();
    folder
}

/// Restores by `mle` unless `args` name a method: it is fast, and these tests hold for all methods.
fn restore(folder: &Path, args: &str) {
    let quick = if args.contains("--method") { "" } else { " --method mle" };
    qudi(folder)
        .arg("restore")
        .args((args.to_owned() + quick).split_whitespace())
        .assert()
        .success();
}

/// Reads name and content of every file of a folder.
fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    listing(folder)
        .into_iter()
        .map(|name| (name.clone(), std::fs::read(folder.join(name)).unwrap()))
        .collect()
}

#[test]
fn every_output_holds_the_same_frames() {
    let folder = burst("restore-outputs", 14);
    for output in ["png", "a.npy", "a.tif", "a.gif"] {
        restore(&folder, &format!("b.npy -o {output}"));
    }
    let array = std::fs::read(folder.join("a.npy")).unwrap();
    let values: Vec<f32> = array[128..]
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    assert_eq!(values.len(), 14 * 64 * 80);
    for frame in 0..14 {
        let png =
            image::open(folder.join(format!("png/frame_{frame:06}.png"))).unwrap().into_luma16();
        for (value, &stored) in values[frame * 64 * 80..].iter().zip(png.as_raw()) {
            assert_eq!((value.clamp(0.0, 1.0) * 65535.0).round() as u16, stored);
        }
    }
    let mut tiff =
        tiff::decoder::Decoder::new(std::fs::File::open(folder.join("a.tif")).unwrap()).unwrap();
    let first = image::open(folder.join("png/frame_000000.png")).unwrap().into_luma16();
    let tiff::decoder::DecodingResult::U16(page) = tiff.read_image().unwrap() else {
        panic!("16-bit pages")
    };
    assert_eq!(&page, first.as_raw());
    restore(&folder, "b.npy -o f.tif --float");
    let mut floats =
        tiff::decoder::Decoder::new(std::fs::File::open(folder.join("f.tif")).unwrap()).unwrap();
    for frame in values.chunks(64 * 80) {
        let tiff::decoder::DecodingResult::F32(page) = floats.read_image().unwrap() else {
            panic!("float pages")
        };
        assert_eq!(page, frame, "nothing clipped or rounded");
        let _ = floats.more_images().then(|| floats.next_image().unwrap());
    }
    assert!(!floats.more_images());
    qudi(&folder).args("restore b.npy --method mle -o g.npy --float".split(' ')).assert().code(2);
    let piped =
        qudi(&folder).args("restore b.npy --method mle -o -".split(' ')).output().unwrap().stdout;
    assert!(piped.starts_with(b"YUV4MPEG2 W80 H64 F25:1"));
    assert_eq!(
        piped.iter().position(|&b| b == b'\n').unwrap() + 1 + 14 * (6 + 64 * 80),
        piped.len()
    );
}

#[test]
fn run_killed_ten_times_equals_undisturbed_run() {
    let folder = burst("restore-kill", 600);
    restore(&folder, "b.npy -o whole --chi-map whole.npy --side-by-side whole.png");
    let finished = || {
        let files = std::fs::read_dir(folder.join("killed")).into_iter().flatten().flatten();
        files.filter(|file| file.file_name().to_string_lossy().starts_with("frame_")).count()
    };
    for round in 0..10 {
        let before = finished();
        let mut child = Command::new(env!("CARGO_BIN_EXE_qudi"))
            .current_dir(&folder)
            .args("restore b.npy --method mle -o killed -q".split(' '))
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // Killed as soon as it has written a few more frames, at once in the first round.
        while round > 0
            && finished() < before + 1 + round % 4
            && child.try_wait().unwrap().is_none()
        {
            std::thread::sleep(Duration::from_millis(1));
        }
        let _ = child.kill();
        child.wait().unwrap();
        assert!(finished() >= before, "finished frames are kept");
    }
    assert!(finished() < 600, "killed before the end: {}", finished());
    restore(&folder, "b.npy -o killed --chi-map killed.npy --side-by-side killed.png");
    let frames: Vec<_> = contents(&folder.join("killed"))
        .into_iter()
        .filter(|(name, _)| !name.starts_with('.'))
        .collect();
    assert!(frames == contents(&folder.join("whole")), "frames and manifest are the same");
    for output in ["npy", "png"] {
        let read = |name: &str| std::fs::read(folder.join(format!("{name}.{output}"))).unwrap();
        assert!(read("whole") == read("killed"), "and so is what is said of them: {output}");
    }
}

#[test]
fn parts_of_the_work_meet_in_one_folder() {
    let folder = burst("restore-shards", 45);
    restore(&folder, "b.npy -o whole");
    for part in ["2/3", "1/3", "3/3"] {
        restore(&folder, &format!("b.npy -o parts --shard {part}"));
    }
    // The last run completes the manifest with the misfit of all frames, which no part knows.
    let manifest = std::fs::read_to_string(folder.join("parts/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["results"]["chi_square"], serde_json::Value::Null);
    restore(&folder, "b.npy -o parts");
    assert!(contents(&folder.join("whole")) == contents(&folder.join("parts")));
    qudi(&folder)
        .args("restore b.npy --method mle -o x.npy --shard 1/2".split(' '))
        .assert()
        .code(2);
    qudi(&folder).args("restore b.npy --method mle -o x --shard 3/2".split(' ')).assert().code(2);
}

#[test]
fn short_captures_and_long_overlaps_work() {
    let folder = burst("restore-short", 14);
    for end in [1, 2, 10, 11, 12, 13] {
        restore(&folder, &format!("b.npy --end {end} -o short{end}"));
        assert_eq!(listing(&folder.join(format!("short{end}"))).len(), end + 1);
    }
    restore(&folder, "b.npy --overlap 10 --method average -o dense");
    let refused = qudi(&folder)
        .args("restore b.npy --method mle --overlap 11 -o no".split(' '))
        .assert()
        .code(2);
    let words = String::from_utf8_lossy(&refused.get_output().stderr).into_owned();
    assert!(words.contains("windows are longer than their overlap"), "{words}");
    assert!(!folder.join("no").exists());
}

/// Options for facts that a pipe does not carry.
const PIPE_OPTIONS: &str = "--sensor qudi-paper --ppp 9.75";

fn piped(folder: &Path, args: &str, input: &[u8]) -> std::process::Output {
    let mut command = qudi(folder);
    let quick = if args.contains("--method") { "" } else { " --method mle" };
    command.arg("restore").args((args.to_owned() + quick).split_whitespace());
    command.args(PIPE_OPTIONS.split(' '));
    command.write_stdin(input).output().unwrap()
}

#[test]
fn pipe_restores_the_same_frames_as_a_file() {
    let folder = burst("restore-pipe", 43);
    restore(&folder, &format!("b.npy -o file.npy --method average {PIPE_OPTIONS}"));
    let expected = std::fs::read(folder.join("file.npy")).unwrap();
    let array = std::fs::read(folder.join("b.npy")).unwrap();
    let raw = &array[128..];
    let raw_options = "--format raw-u8 --size 64x80";
    for (name, options, input) in [("npy", "", &array[..]), ("raw", raw_options, raw)] {
        let args = format!("- -o {name}.npy --method average --side-by-side {name}.png {options}");
        assert!(piped(&folder, &args, input).status.success());
        let found = std::fs::read(folder.join(format!("{name}.npy"))).unwrap();
        assert!(found == expected, "{name}");
        assert!(folder.join(format!("{name}.png")).is_file());
    }
    let args = format!("- -o frames --method average {raw_options}");
    assert!(piped(&folder, &args, raw).status.success());
    assert_eq!(listing(&folder.join("frames")).len(), 43 + 1);
    let again = piped(&folder, &args, raw);
    assert_eq!(again.status.code(), Some(2), "a pipe is not gone on with");
    assert!(String::from_utf8_lossy(&again.stderr).contains("--force"));
    assert!(piped(&folder, &format!("{args} --force"), &raw[..20 * 5120]).status.success());
    assert_eq!(listing(&folder.join("frames")).len(), 20 + 1, "nothing of the old run is left");
}

/// Frames are written while the pipe is still open.
#[test]
fn restores_a_running_pipe_frame_by_frame() {
    use std::io::{Read, Write};
    let folder = burst("restore-live", 27);
    let array = std::fs::read(folder.join("b.npy")).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_qudi"))
        .current_dir(&folder)
        .args("restore - -o - -q --format raw-u8 --size 64x80 --method average".split(' '))
        .args(PIPE_OPTIONS.split(' '))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut camera, mut screen) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
    // One window, and as much as the next one adds.
    camera.write_all(&array[128..128 + 19 * 5120]).unwrap();
    camera.flush().unwrap();
    let header = b"YUV4MPEG2 W80 H64 F25:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n";
    let mut first = vec![0; header.len() + 8 * (6 + 5120)];
    screen.read_exact(&mut first).unwrap();
    assert!(first.starts_with(header));
    camera.write_all(&array[128 + 19 * 5120..]).unwrap();
    drop(camera);
    let mut rest = Vec::new();
    screen.read_to_end(&mut rest).unwrap();
    assert_eq!(rest.len(), (27 - 8) * (6 + 5120));
    assert!(child.wait().unwrap().success());
    // The reader of the frames may end early.
    let mut child = Command::new(env!("CARGO_BIN_EXE_qudi"))
        .current_dir(&folder)
        .args("restore b.npy --method mle -o - -q".split(' '))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
}

#[test]
fn rejects_broken_pipes_with_help() {
    let folder = burst("restore-broken", 30);
    let array = std::fs::read(folder.join("b.npy")).unwrap();
    let raw = "--format raw-u8 --size 64x80";
    let cases: [(&str, &[u8], &str); 8] = [
        ("-o a.npy", b"", "nothing came through the pipe"),
        ("-o a.npy", b"YUV4MPEG2 W8 H8 F25:1\n", "pictures, not photon counts"),
        ("-o a.npy", &array[..200], "0 whole ones came"),
        ("-o a.npy", &array[..128 + 25 * 5120], "promises 30 frames, 25 whole ones came"),
        ("-o a.npy --format raw-u8 --size 63x80", &array[128..], "inside a frame"),
        ("-o a.npy --format raw-u8", &array[128..], "how large a frame is"),
        ("-o a.npy --format tiff", &array, "cannot be read from a pipe"),
        ("-o a --shard 1/2", &array, "comes once and whole"),
    ];
    for (args, input, reason) in cases {
        let output = piped(&folder, &format!("- {args}"), input);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args}: {said}");
        assert!(said.contains(reason), "{args}: {said}");
        assert!(said.contains("\n  where: ") && said.contains("\n  help: "), "{said}");
        assert_eq!(listing(&folder), ["b.npy", "b.npy.json"], "{args} left something behind");
    }
    let cut = piped(&folder, &format!("- -o a.npy --lenient {raw}"), &array[128..128 + 100_000]);
    assert!(cut.status.success());
    assert!(String::from_utf8_lossy(&cut.stderr).contains("2720 of 5120 bytes came after 19"));
}
