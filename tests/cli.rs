//! Tests of the command line. The console blocks of `tests/cmd/*.md` are run as written.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};

#[path = "cli/bad_input.rs"]
mod bad_input;
#[path = "cli/baselines.rs"]
mod baselines;
#[path = "cli/browser.rs"]
mod browser;
#[path = "cli/challenge.rs"]
mod challenge;
#[path = "cli/colour.rs"]
mod colour;
#[path = "cli/documentation.rs"]
mod documentation;
#[path = "cli/eval.rs"]
mod eval;
#[path = "cli/field.rs"]
mod field;
#[path = "cli/network.rs"]
mod network;
#[path = "cli/outputs.rs"]
mod outputs;
#[path = "cli/pages.rs"]
mod pages;
#[path = "cli/places.rs"]
mod places;
#[path = "cli/posterior.rs"]
mod posterior;
#[path = "cli/release.rs"]
mod release;
#[path = "cli/report.rs"]
mod report;
#[path = "cli/restore.rs"]
mod restore;
#[path = "cli/safety.rs"]
mod safety;
#[path = "cli/scoring.rs"]
mod scoring;
#[path = "cli/settings.rs"]
mod settings;
#[path = "cli/support.rs"]
mod support;
#[path = "cli/train.rs"]
mod train;
#[path = "cli/view.rs"]
mod view;
#[path = "cli/warnings.rs"]
mod warnings;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Runs every console block of tests/cmd, each page in an empty folder.
#[test]
fn console_blocks_run_as_documented() {
    let cases = Path::new(env!("CARGO_TARGET_TMPDIR")).join("console");
    let _ = std::fs::remove_dir_all(&cases);
    for entry in std::fs::read_dir(root().join("tests/cmd")).unwrap() {
        let page = entry.unwrap().path();
        let stem = page.file_stem().unwrap().to_str().unwrap();
        // An `.out` folder next to a case makes its commands share a sandbox.
        std::fs::create_dir_all(cases.join(format!("{stem}.in"))).unwrap();
        std::fs::create_dir_all(cases.join(format!("{stem}.out"))).unwrap();
        std::fs::copy(&page, cases.join(format!("{stem}.md"))).unwrap();
    }
    // Graphics drivers write warnings to standard error where nobody is logged in.
    let runtime = cases.to_str().unwrap();
    let run = trycmd::TestCases::new();
    run.env("NO_COLOR", "1").env("XDG_RUNTIME_DIR", runtime).case(cases.join("*.md")).run();
}

#[test]
fn settings_reference_is_up_to_date() {
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_qudi"))
        .args(["config", "docs"])
        .output()
        .unwrap();
    let committed = std::fs::read_to_string(root().join("docs/settings.md")).unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), committed, "run `just config-docs`");
}

#[test]
fn accepts_the_example_settings() {
    let folder = support::scratch("example-settings");
    let settings = root().join("crates/qudi-cli/src/settings/example.toml");
    support::qudi(&folder)
        .args("simulate scene:text --size 32x32 --frames 3 -o out.npy --config".split(' '))
        .arg(settings)
        .assert()
        .success();
    assert_eq!(support::listing(&folder), ["out.npy", "out.npy.json"]);
}
