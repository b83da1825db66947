//! Inputs and other programs' files are kept; results of other captures and thresholds without a number are
//! refused.

use crate::support::{listing, npy_bytes, qudi, refused, run, scratch};
use std::path::PathBuf;

/// Creates a folder with a burst `b.npy`, its truth as a folder `fr`, and weights.
fn prepared(name: &str) -> PathBuf {
    let folder = scratch(name);
    run(
        &folder,
        "simulate scene:text --size 32x40 --frames 13 --ppp 9.75 --seed 3 -o b.npy --truth fr -q",
    );
    let weights = crate::root().join("crates/qudi-cli/weights/regression.safetensors");
    std::fs::copy(weights, folder.join("w.safetensors")).unwrap();
    folder
}

#[test]
fn rejects_outputs_that_are_inputs_despite_force() {
    let folder = prepared("safety-inputs");
    run(&folder, "convert b.npy -o d.npy -q");
    std::fs::hard_link(folder.join("b.npy"), folder.join("hard.npy")).unwrap();
    #[cfg(unix)]
    std::os::unix::fs::symlink("b.npy", folder.join("soft.npy")).unwrap();
    let before = std::fs::read(folder.join("b.npy")).unwrap();
    let frames = listing(&folder.join("fr"));
    let mut cases = vec![
        "restore b.npy --method average -o b.npy -f",
        "restore b.npy --method average -o hard.npy -f",
        "restore b.npy --method average -o ./fr/../b.npy -f",
        "restore b.npy --method average -o o.npy --chi-map b.npy -f",
        "restore b.npy --method average -o o.npy --side-by-side b.npy -f",
        "restore fr --sensor qudi-paper --ppp 3 --bits 16 --method average -o fr -f",
        "convert b.npy -o b.npy -f",
        "convert hard.npy -o b.npy -f",
        "convert fr -o fr -f",
        "simulate fr -o s.npy --truth fr -f",
        "simulate fr -o fr -f",
        "simulate fr -o fr/frame_000000.png -f",
        "simulate --from b.npy.json -o b.npy -f",
        "simulate scene:text -o s.npy --truth s.npy -f",
        "simulate scene:text -o s.npy --preview s.npy.json -f",
        "calibrate d.npy --sensor qudi-paper -o d.toml --dcr d.dark.npy -f",
        "eval fr --export-photons fr -f",
        "eval b.npy --capture --csv b.npy -f",
        "publish w.safetensors -o w.safetensors -f",
        "info b.npy --preview b.npy -f",
    ];
    if cfg!(unix) {
        cases.push("restore b.npy --method average -o soft.npy -f");
        cases.push("convert soft.npy -o b.npy -f");
    }
    std::fs::copy(folder.join("b.npy"), folder.join("d.dark.npy")).unwrap();
    for args in cases {
        refused(&folder, args, &["output"]);
        assert!(std::fs::read(folder.join("b.npy")).unwrap() == before, "{args}");
        assert_eq!(listing(&folder.join("fr")), frames, "{args}");
    }
}

#[test]
fn force_deletes_no_foreign_file() {
    let folder = prepared("safety-force");
    let foreign = |name: &str, files: &[(&str, &str)]| {
        std::fs::create_dir(folder.join(name)).unwrap();
        for (file, text) in files {
            std::fs::write(folder.join(name).join(file), text).unwrap();
        }
    };
    foreign("m", &[("frame_000000.png", ""), ("notes.tex", "mine")]);
    let simulate = "simulate scene:text --size 32x40 --frames 3 --seed 1 -o s.npy -q -f --truth";
    refused(&folder, &format!("{simulate} m"), &["the output holds", "manifest.json"]);
    assert_eq!(listing(&folder.join("m")), ["frame_000000.png", "notes.tex"]);
    // Also next to frames that this program wrote.
    std::fs::write(folder.join("fr/notes.tex"), "mine").unwrap();
    refused(&folder, &format!("{simulate} fr"), &["notes.tex"]);
    refused(&folder, "restore b.npy --method average -o fr -f", &["manifest.json", "restoration"]);
    run(&folder, "restore b.npy --method average -o out -q");
    refused(&folder, "restore b.npy --method average -o out --shard 2/2 -f", &["one part"]);
    #[cfg(unix)]
    refused(&folder, "eval fr --method average --csv /dev/null -f", &["not a regular file"]);
}

#[test]
fn refuses_to_resume_frames_of_another_capture() {
    let folder = prepared("safety-resume");
    std::fs::write(folder.join("mask.npy"), npy_bytes("|u1", "(32, 40)", &[0; 32 * 40])).unwrap();
    let restore = "restore b.npy --method average -o out --mask mask.npy";
    run(&folder, restore);
    assert!(run(&folder, restore).contains("resumed"));
    let mut bad = [0; 32 * 40];
    bad[7] = 1;
    std::fs::write(folder.join("mask.npy"), npy_bytes("|u1", "(32, 40)", &bad)).unwrap();
    refused(&folder, restore, &["repaired_pixels was 0, now 1"]);
    std::fs::write(folder.join("mask.npy"), npy_bytes("|u1", "(32, 40)", &[0; 32 * 40])).unwrap();
    run(&folder, restore);
    run(&folder, "simulate scene:text --size 32x40 --frames 13 --ppp 9.75 --seed 4 -o b.npy -q -f");
    refused(&folder, restore, &["other data", "capture"]);
}

#[test]
fn nan_does_not_pass_a_minimum_psnr() {
    let folder = scratch("safety-nan");
    let args = "eval scene:gratings --frames 11 --ppp 1e6 --method average --min-psnr 99";
    refused(&folder, args, &["NaN"]);
}

#[test]
fn clips_of_one_stem_keep_names_of_their_own() {
    let folder = scratch("safety-clips");
    for (name, size) in [("run.1", "32x40"), ("run.2", "40x32")] {
        let args = format!(
            "simulate scene:text --size {size} --frames 3 --ppp 9 --seed 1 -o s.npy -q -f --truth"
        );
        std::fs::create_dir_all(folder.join("clips")).unwrap();
        qudi(&folder).args(args.split(' ')).arg("t").assert().success();
        std::fs::rename(folder.join("t"), folder.join("clips").join(name)).unwrap();
    }
    run(&folder, "eval clips --method average --ppp 9 --frames 3 --csv f.csv --html r.html");
    let csv = std::fs::read_to_string(folder.join("f.csv")).unwrap();
    assert!(csv.contains("run.1") && csv.contains("run.2"), "{csv}");
}

#[test]
fn rejects_flags_of_another_method() {
    let folder = prepared("safety-flags");
    let flags = [
        "--tile 64",
        "--samples 2",
        "--passes 2",
        "--flow learnt",
        "--device cpu",
        "--spacing linear",
    ];
    for flag in ["--steps 3"].into_iter().chain(flags) {
        let name = flag.split(' ').next().unwrap();
        let whose = match name {
            "--tile" | "--device" => "is for networks",
            _ => "is for method qudi",
        };
        let expected = [name, whose];
        refused(&folder, &format!("restore b.npy --method average -o o {flag}"), &expected);
        refused(&folder, &format!("eval fr --method average,mle {flag}"), &expected);
        refused(&folder, &format!("bench --size 16x16 --method average {flag}"), &expected);
    }
    refused(&folder, "restore b.npy -o o --device cpu --samples 2", &["--method qudi-diffusion"]);
    refused(&folder, "restore b.npy -o o --method qudi-diffusion --passes 0", &["from 1 to 10"]);
    refused(&folder, "restore b.npy -o o --method mle --seed 3", &["--seed is for method qudi"]);
    refused(
        &folder,
        "restore b.npy -o o --device cpu --seed 3",
        &["--seed is for method qudi-diffusion"],
    );
}

#[test]
fn weights_restore_equal_frames_by_name_and_path() {
    let folder = prepared("safety-weights");
    run(&folder, "publish w.safetensors -o p.safetensors -q");
    let frames = |weights: &str, to: &str| {
        let said = run(&folder, &format!("restore b.npy --device cpu -o {to} {weights}"));
        assert!(said.contains("by qudi (regression) on cpu"), "{said}");
        std::fs::read(folder.join(to)).unwrap()
    };
    let built_in = frames("", "a.npy");
    assert!(built_in == frames("--weights w.safetensors", "b0.npy"));
    assert!(built_in == frames("--weights p.safetensors", "c.npy"));
    let said = run(&folder, "restore b.npy --method qudi-diffusion --device cpu --steps 2 -o two");
    assert!(said.contains("by qudi-diffusion (diffusion in 2 steps) on cpu"), "{said}");
    let manifest = std::fs::read_to_string(folder.join("two/manifest.json")).unwrap();
    assert!(manifest.contains("\"mode\": \"diffusion in 2 steps\""), "{manifest}");
}

/// Numbers that once filled the memory, aborted the program or were accepted are refused with their range.
#[test]
fn rejects_numbers_out_of_range_with_the_range() {
    let folder = prepared("safety-numbers");
    for flag in [
        "--ppp 1e300",
        "--ppp nan",
        "--gain 0",
        "--gain -1",
        "--gain nan",
        "--exposure 2",
        "-j 100000",
        "-j 0",
        "--overlap 99999999999999999999",
        "--bits 0",
        "--sum 0",
    ] {
        let args = format!("restore b.npy --method average -o o.npy {flag}");
        refused(&folder, &args, &["give a number from"]);
    }
    refused(&folder, "calibrate b.npy -o c.toml --gain 0", &["give a number from"]);
    assert!(!folder.join("c.toml").exists());
}

#[cfg(unix)]
#[test]
fn settings_and_weights_are_regular_files() {
    let folder = prepared("safety-special");
    refused(&folder, "light --lux 1 --config /dev/zero", &["not a regular file"]);
    refused(&folder, "restore b.npy -o o --weights /dev/zero", &["not a regular file"]);
}
