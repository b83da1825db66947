//! `qudi eval`: the same photons for everyone, bars, exports.

use crate::outputs::{listing, qudi, scratch};
use serde_json::Value;
use std::path::Path;

fn eval(folder: &Path, args: &str) -> Value {
    let output =
        qudi(folder).args("eval --json".split(' ')).args(args.split(' ')).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn other_programs_are_scored_on_the_same_photons() {
    let folder = scratch("eval-external");
    let clips = folder.join("clips");
    std::fs::create_dir(&clips).unwrap();
    for (name, seed) in [("a", "1"), ("b", "2")] {
        qudi(&clips)
            .args(
                "simulate scene:dead-leaves --size 48x64 --frames 13 --ppp 3 --seed 1 -o x.npy"
                    .split(' '),
            )
            .args(["--scene-seed", seed, "--truth", &format!("{name}.npy"), "-q", "-f"])
            .assert()
            .success();
    }
    for file in ["x.npy", "x.npy.json"] {
        std::fs::remove_file(clips.join(file)).unwrap();
    }
    let ours = eval(&folder, "clips --method mle --ppp 9.75 --export-photons photons");
    assert_eq!(
        listing(&folder.join("photons")),
        ["a-ppp9_75.npy", "a-ppp9_75.npy.json", "b-ppp9_75.npy", "b-ppp9_75.npy.json"]
    );
    std::fs::create_dir(folder.join("theirs")).unwrap();
    for name in ["a-ppp9_75", "b-ppp9_75"] {
        qudi(&folder)
            .args(["restore", &format!("photons/{name}.npy"), "-o", &format!("theirs/{name}.npy")])
            .args("--mask none -q".split(' '))
            .assert()
            .success();
    }
    let both = eval(&folder, "clips --method mle --ppp 9.75 --external theirs=theirs");
    // Times differ; everything else is the same figure.
    for key in ["psnr_a", "psnr", "ssim", "ssim_g", "chi_square"] {
        let (own, external) = (&both["rows"][0][key], &both["rows"][1][key]);
        assert_eq!(own, &ours["rows"][0][key], "a seed gives the same photons");
        let mean = |v: &Value| v["all"]["mean"].as_f64().or(v.as_f64()).unwrap();
        assert!((mean(own) - mean(external)).abs() < 1e-4, "{key}: {own} {external}");
    }
    let missing = qudi(&folder)
        .args("eval clips --ppp 3.25 --external theirs=theirs".split(' '))
        .assert()
        .code(2);
    assert!(String::from_utf8_lossy(&missing.get_output().stderr).contains("a-ppp3_25"));
}

#[test]
fn more_light_is_better_and_bars_are_kept() {
    let folder = scratch("eval-bars");
    let found = eval(&folder, "scene:text --ppp 3.25,26 --frames 11 --csv f.csv --markdown t.md");
    let psnr = |row: usize| found["rows"][row]["psnr_a"]["all"]["mean"].as_f64().unwrap();
    assert!(psnr(2) > psnr(0) + 1.0 && psnr(3) > psnr(1) + 1.0, "{found}");
    let csv = std::fs::read_to_string(folder.join("f.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + 4 * 11);
    assert!(std::fs::read_to_string(folder.join("t.md")).unwrap().contains("| mle | 26 |"));
    let command = |bar: &str| {
        let mut command = qudi(&folder);
        command
            .args("eval scene:text --ppp 26 --method mle --frames 11 --min-psnr".split(' '))
            .arg(bar);
        command.assert()
    };
    command("10").success();
    command("90").code(1);
    qudi(&folder).args("eval scene:text --method best".split(' ')).assert().code(2);
}

#[test]
fn the_report_is_one_file_that_fetches_nothing() {
    let folder = scratch("eval-html");
    eval(&folder, "scene:dead-leaves --ppp 3.25,26 --frames 11 --html report.html");
    let page = std::fs::read_to_string(folder.join("report.html")).unwrap();
    for part in ["<table>", "<svg", "polyline", "dead-leaves", "type=\"range\"", "mle: error"] {
        assert!(page.contains(part), "{part}");
    }
    for fetched in ["http://", "https://", "src=\"/", "url("] {
        assert!(!page.contains(fetched), "{fetched}");
    }
    // Synthetic scenes have a true flow, and so a figure for flicker.
    let found = eval(&folder, "scene:dead-leaves --ppp 26 --frames 11");
    let flicker = |row: usize| found["rows"][row]["flicker"].as_f64().unwrap();
    assert!(flicker(0) > 0.0 && flicker(1) > flicker(0), "a shorter mean is noisier: {found}");
}

#[test]
fn the_quiver_protocol_judges_the_middle_of_every_window() {
    let folder = scratch("eval-quiver");
    let quiver = |seed: u32| {
        eval(&folder, &format!("scene:text --ppp 9.75 --frames 14 --protocol quiver --seed {seed}"))
    };
    let first = quiver(1);
    assert_eq!(first["protocol"], "quiver");
    let frames = &first["rows"][0]["clips"][0]["frames"];
    assert_eq!(frames.as_array().unwrap().len(), 14 - 11 + 1);
    assert_eq!(frames, &quiver(1)["rows"][0]["clips"][0]["frames"], "seeded, unlike the original");
    assert_ne!(frames, &quiver(2)["rows"][0]["clips"][0]["frames"]);
    qudi(&folder)
        .args("eval scene:text --protocol quiver --export-photons p".split(' '))
        .assert()
        .code(2);
    qudi(&folder).args("eval scene:text --protocol quiver --frames 10".split(' ')).assert().code(2);
}
