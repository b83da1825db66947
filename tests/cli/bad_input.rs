//! Bad input: a three-part error, exit code 2, nothing half-written, no panic.

use super::support::{listing, npy_bytes, qudi, scratch};
use std::path::Path;

/// Runs `qudi`, checks the form of its error and the exit code, and returns standard error.
fn refused(folder: &Path, args: &[&str]) -> String {
    let before = listing(folder);
    let output = qudi(folder).args(args).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
    assert!(!said.contains("panicked"), "{args:?}: {said}");
    assert!(said.starts_with("error: "), "{args:?}: {said}");
    assert!(said.contains("\n  where: ") && said.contains("\n  help: "), "{args:?}: {said}");
    assert!(output.stdout.is_empty(), "{args:?}");
    assert_eq!(before, listing(folder), "{args:?} left something behind");
    said
}

#[test]
fn rejects_damaged_files() {
    let folder = scratch("damaged");
    let ones = |n: usize, v: f32| -> Vec<u8> { (0..n).flat_map(|_| v.to_le_bytes()).collect() };
    let png = {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image::GrayImage::from_pixel(8, 8, image::Luma([90]))
            .write_to(&mut bytes, image::ImageFormat::Png)
            .unwrap();
        bytes.into_inner()
    };
    let mut huge_png = png.clone();
    huge_png[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    let nan = [ones(63, 0.5), ones(1, f32::NAN)].concat();
    let files: Vec<(&str, Vec<u8>, &str)> = vec![
        ("empty.npy", vec![], "ends inside its .npy header"),
        ("text.npy", b"hello, this is no array".to_vec(), "not a .npy file"),
        ("truncated.npy", npy_bytes("<f4", "(3, 8, 8)", &ones(100, 0.5)), "promises 768 bytes"),
        (
            "huge.npy",
            npy_bytes("|u1", "(99999999999, 99999999999, 99999999999)", &[0; 64]),
            "impossible shape",
        ),
        ("wide.npy", npy_bytes("|u1", "(1, 4294967296, 4294967296)", &[0; 64]), "impossible shape"),
        ("zero.npy", npy_bytes("|u1", "(4, 0, 8)", &[]), "not possible"),
        ("none.npy", npy_bytes("|u1", "(0, 8, 8)", &[]), "no frames"),
        ("flat.npy", npy_bytes("|u1", "(64,)", &[0; 64]), "is no clip"),
        ("complex.npy", npy_bytes("<c8", "(1, 2, 2)", &[0; 32]), "`<c8`"),
        ("nan.npy", npy_bytes("<f4", "(1, 8, 8)", &nan), "NaN"),
        ("negative.npy", npy_bytes("<f4", "(1, 8, 8)", &ones(64, -0.5)), "-0.5"),
        ("bright.npy", npy_bytes("<f4", "(1, 8, 8)", &ones(64, 200.0)), "white"),
        ("black.npy", npy_bytes("<f4", "(1, 8, 8)", &ones(64, 0.0)), "exposure"),
        ("empty.png", vec![], "not a readable image"),
        ("truncated.png", png[..40].to_vec(), "not a readable image"),
        ("huge.png", huge_png, "not a readable image"),
        ("text.jpg", b"not a picture at all".to_vec(), "not a readable image"),
        ("empty.gif", vec![], "not a readable GIF"),
        ("cut.gif", b"GIF89a\x08\x00\x08\x00\x80\x00\x00".to_vec(), "not a readable GIF"),
        ("empty.y4m", vec![], "empty"),
        ("text.y4m", b"YUV4MPEG3 W8 H8\n".to_vec(), "Y4M"),
        ("huge.y4m", b"YUV4MPEG2 W99999999 H99999999 F1:1\nFRAME\n".to_vec(), ""),
        (
            "cut.y4m",
            [b"YUV4MPEG2 W8 H8 F1:1 Cmono\nFRAME\n".as_slice(), &[9; 30]].concat(),
            "ends inside a frame",
        ),
    ];
    for (name, bytes, _) in &files {
        std::fs::write(folder.join(name), bytes).unwrap();
    }
    for (name, _, reason) in &files {
        let said = refused(&folder, &["simulate", name, "-o", "out.npy"]);
        assert!(said.contains(reason), "{name}: {said}");
    }
}

#[test]
fn rejects_unsuitable_inputs_and_outputs() {
    let folder = scratch("unsuitable");
    std::fs::create_dir(folder.join("nothing")).unwrap();
    std::fs::create_dir(folder.join("mixed")).unwrap();
    for (name, side) in [("1.png", 8), ("2.png", 9)] {
        image::GrayImage::from_pixel(side, 8, image::Luma([90]))
            .save(folder.join("mixed").join(name))
            .unwrap();
    }
    std::fs::write(folder.join("taken.npy"), "mine").unwrap();
    std::fs::write(folder.join("transforms.json"), "mine").unwrap();
    let scene = "scene:text";
    for (args, reason) in [
        (vec!["missing", "-o", "out.npy"], "cannot find the input"),
        (vec!["nothing", "-o", "out.npy"], "holds no images"),
        (vec!["mixed", "-o", "out.npy"], "8 x 9 among images of 8 x 8"),
        (vec!["mixed", "-o", "out", "--truth", "truth"], "8 x 9"),
        (
            vec![scene, "-o", "out.npy", "--sensor", "spad512s", "--visionsim", "--truth", "t"],
            "transforms.json",
        ),
        (vec!["mixed", "-o", "out.npy", "--flow", "flow.npy"], "no known flow"),
        (vec!["scene:nowhere", "-o", "out.npy"], "no procedural scene named `nowhere`"),
        (vec!["mixed", "--motion", "pan:1,1", "-o", "out.npy"], "recorded clip"),
        (vec![scene, "--motion", "spin:1", "-o", "out.npy"], "`spin` is no motion"),
        (vec![scene, "-o", "out.mp4"], "not written as .mp4"),
        (vec![scene, "-o", "taken.npy"], "exists already"),
        (vec![scene, "-o", "nothing", "--force", "--truth", "mixed"], "did not write"),
        (vec![scene, "-o", "no/such/folder/out.npy"], "cannot create the output"),
        (vec![scene, "-o", "out.npy", "--visionsim"], "visionsim"),
        (vec![scene, "-o", "-", "--json"], "standard output"),
        (vec![scene, "-o", "out.npy", "--frames", "0"], "too short"),
        (vec![scene, "-o", "out.npy", "--frames", "9999999999999999"], "up to 1099511627776"),
        (vec![scene, "-o", "out.npy", "--instants", "0"], "0 instants"),
        (vec![scene, "-o", "out.npy", "--instants", "999999999999"], "instants"),
        (vec![scene, "-o", "out.npy", "--ppp", "-1"], "-1 photons"),
        (vec![scene, "-o", "out.npy", "--ppp", "nan"], "`simulate.ppp` is not a finite number"),
        (vec![scene, "-o", "out.npy", "--ppp", "1e300"], "photons per pixel"),
        (vec![scene, "-o", "out.npy", "--ppp", "0"], "gain rule"),
        (vec![scene, "-o", "out.npy", "--exposure", "0"], "exposure of 0"),
        (vec![scene, "-o", "out.npy", "--exposure", "1e-30"], "electrons in a white pixel"),
        (vec![scene, "-o", "out.npy", "--ppp-def", "dn"], "gain rule `quiver`"),
        (vec![scene, "-o", "out.npy", "--ppp-def", "photons"], "photons"),
        (vec![scene, "-o", "out.npy", "--speed", "-2"], "a speed of -2"),
    ] {
        let args = [vec!["simulate"], args].concat();
        let said = refused(&folder, &args);
        assert!(said.contains(reason), "{args:?}: {said}");
    }
    assert_eq!(std::fs::read_to_string(folder.join("taken.npy")).unwrap(), "mine");
}

#[test]
fn rejects_impossible_sensors() {
    let folder = scratch("sensors");
    for (name, toml, reason) in [
        ("noise.toml", "base = \"ideal\"\nread_noise = -1", "read_noise is -1"),
        ("qe.toml", "base = \"ideal\"\nquantum_efficiency = 1.2", "quantum_efficiency is 1.2"),
        ("bits.toml", "base = \"ideal\"\nbits = 0", "bits is 0"),
        ("deep.toml", "base = \"ideal\"\nbits = 17", "bits is 17"),
        ("nan.toml", "base = \"ideal\"\nread_noise = nan", "read_noise is not a finite number"),
        ("well.toml", "base = \"ideal\"\nfull_well = 0", "full_well is 0"),
        ("gain.toml", "base = \"ideal\"\ngain = \"high\"", "`high` is no gain"),
        ("key.toml", "base = \"ideal\"\nread_nois = 1", "read_nois"),
        ("kind.toml", "base = \"ideal\"\nresponse = \"square\"", "square"),
        ("base.toml", "base = \"idea\"", "no preset named `idea`"),
        ("bare.toml", "name = \"x\"", "missing field"),
        ("syntax.toml", "name = \nbits", "not a TOML document"),
        ("sum.toml", "base = \"swissspad2\"\nframes_summed = 0", "frames_summed is 0"),
        ("rate.toml", "base = \"ideal\"\ndark = \"5/s\"", "no frame rate"),
        ("after.toml", "base = \"ideal\"\n[defects]\nafterpulse = 0.1", "afterpulse"),
        (
            "hot.toml",
            "base = \"ideal\"\n[defects]\nhot_fraction = 0.1",
            "hot pixels have no dark rate",
        ),
        ("dead.toml", "base = \"swissspad2\"\n[defects]\ndead_time_ns = 10", "dead_time_ns"),
        ("map.toml", "base = \"ideal\"\n[defects]\ndark_map = \"no.npy\"", "no.npy"),
        ("folder.toml/", "", ""),
    ] {
        if name.ends_with('/') {
            std::fs::create_dir(folder.join(name)).unwrap();
        } else {
            std::fs::write(folder.join(name), toml).unwrap();
        }
        let said = refused(
            &folder,
            &["simulate", "scene:text", "-o", "out.npy", "--sensor", name.trim_end_matches('/')],
        );
        assert!(said.contains(reason), "{name}: {said}");
    }
    let said = refused(&folder, &["simulate", "scene:text", "-o", "out.npy", "--sensor", "spad51"]);
    assert!(said.contains("did you mean `spad512s`?"), "{said}");
    let said = refused(&folder, &["simulate", "scene:text", "-o", "out.npy", "--qe", "1.5"]);
    assert!(said.contains("quantum_efficiency is 1.5"), "{said}");
    let said =
        refused(&folder, &["simulate", "scene:text", "-o", "out.npy", "--set", "sensor.bit=3"]);
    assert!(said.contains("did you mean `sensor.bits`?"), "{said}");
}

#[test]
fn rejects_unknown_settings_from_every_layer() {
    let folder = scratch("settings");
    std::fs::write(folder.join("a.toml"), "[simulate]\npp = 3\n").unwrap();
    std::fs::write(folder.join("b.toml"), "not toml at all [").unwrap();
    std::fs::write(folder.join("c.toml"), [0xff, 0xfe, 0x00]).unwrap();
    for file in ["a.toml", "b.toml", "c.toml", "none.toml"] {
        let said = refused(&folder, &["simulate", "scene:text", "-o", "out.npy", "-c", file]);
        assert!(said.contains(file), "{said}");
    }
    refused(&folder, &["simulate", "scene:text", "-o", "out.npy", "--set", "simulate.ppp"]);
    let said = refused(
        &folder,
        &["simulate", "scene:text", "-o", "out.npy", "--set", "simulate.ppp=bright"],
    );
    assert!(said.contains("`simulate.ppp` cannot be"), "{said}");
    let output =
        qudi(&folder).args(["config", "show"]).env("QUDI_SIMULATE_PP", "3").output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("QUDI_SIMULATE_PPP"));
}

#[test]
fn rejects_record_that_contradicts_its_file() {
    let folder = scratch("records");
    qudi(&folder)
        .args("simulate scene:text --size 16x16 --seed 1 -o a.npy".split(' '))
        .assert()
        .success();
    let record = std::fs::read_to_string(folder.join("a.npy.json")).unwrap();
    std::fs::write(folder.join("none.json"), "{}").unwrap();
    std::fs::write(
        folder.join("qe.json"),
        record.replace("\"quantum_efficiency\": 0.8", "\"quantum_efficiency\": 8"),
    )
    .unwrap();
    std::fs::write(folder.join("future.json"), record.replace("\"version\": 1", "\"version\": 99"))
        .unwrap();
    std::fs::write(folder.join("changed.json"), record.replace("\"speed\": 2.0", "\"speed\": 3.0"))
        .unwrap();
    std::fs::write(
        folder.join("size.json"),
        record.replace("\"height\": 16", "\"height\": 9999999999999"),
    )
    .unwrap();
    for (name, reason) in [
        ("none.json", "missing field"),
        ("qe.json", "quantum_efficiency"),
        ("future.json", "version 99"),
        ("changed.json", "has changed"),
        ("size.json", "not possible"),
    ] {
        let said = refused(&folder, &["simulate", "--from", name, "-o", "b.npy"]);
        assert!(said.contains(reason), "{name}: {said}");
    }
}

#[test]
fn explains_videos_without_ffmpeg() {
    let folder = scratch("ffmpeg");
    std::fs::write(folder.join("clip.mp4"), "not a video").unwrap();
    let output = qudi(&folder)
        .args(["simulate", "clip.mp4", "-o", "out.npy"])
        .env("PATH", "")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2));
    assert!(
        said.contains("no `ffmpeg` on PATH") && said.contains("help: install ffmpeg"),
        "{said}"
    );
    let said = refused(&folder, &["simulate", "clip.mp4", "-o", "out.npy"]);
    assert!(said.contains("ffmpeg"), "{said}");
}

#[cfg(unix)]
#[test]
fn rejects_names_that_are_not_utf8() {
    use std::os::unix::ffi::OsStrExt;
    let folder = scratch("names");
    let name = std::ffi::OsStr::from_bytes(b"clip\xff.npy");
    std::fs::write(folder.join(name), npy_bytes("|u1", "(1, 8, 8)", &[99; 64])).unwrap();
    let output = qudi(&folder).arg("simulate").arg(name).args(["-o", "out.npy"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.starts_with("error: an argument is not UTF-8"), "{said}");
    assert!(said.contains("  where: ") && said.contains("  help: rename"), "{said}");
    assert!(!folder.join("out.npy").exists());
}

/// Ctrl-C during a run ends it with exit code 130 and leaves no file, finished or temporary.
#[cfg(unix)]
#[test]
fn interrupt_leaves_no_file_behind() {
    let folder = scratch("interrupt");
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_qudi"))
        .args("simulate scene:gratings --size 64x64 --frames 3000 -o out.npy --truth truth --preview p.gif".split(' '))
        .current_dir(&folder)
        .spawn()
        .unwrap();
    // Waits until the truth's folder is there; files have no name before they are whole.
    let started = std::time::Instant::now();
    while listing(&folder).is_empty() {
        assert!(started.elapsed().as_secs() < 120, "no output was begun");
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
    let killed = std::process::Command::new("sh")
        .args(["-c", &format!("kill -INT {}", child.id())])
        .status()
        .unwrap();
    assert!(killed.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(listing(&folder), Vec::<String>::new());
}
