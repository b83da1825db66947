//! The shell blocks of the documentation, run as they are: each page in a folder of its own, with captures,
//! clips and a camera that the test makes. Blocks marked `sh no-run` need a card, data or minutes; a test of
//! the library checks the options of their commands, too.

use super::challenge::{still, write_cube};
use super::support::{run, scratch};
use crate::root;
use assert_cmd::Command;
use std::fmt::Write;
use std::path::Path;

/// Number of blocks in all pages that are marked `sh no-run`.
const BLOCKS_NOT_RUN: usize = 31;

/// Pages with shell blocks that run.
const SHELL_PAGES: [&str; 6] = [
    "README.md",
    "docs/quickstart.md",
    "docs/methods.md",
    "docs/sensors.md",
    "docs/colour.md",
    "docs/challenge.md",
];

/// Pages whose blocks of Python the package's tests run (crates/qudi-python/tests/test_documentation.py).
const PYTHON_PAGES: [&str; 4] =
    ["README.md", "docs/quickstart.md", "docs/formats.md", "docs/python.md"];

/// Pages whose tables a test reads: below, of recipes (crates/qudi-train/src/recipe/stage.rs), and of
/// settings, which are the program's own example.
const TABLE_PAGES: [&str; 4] =
    ["docs/sensors.md", "docs/colour.md", "docs/training.md", "docs/settings.md"];

/// What every block begins with. Scenes are small, and outputs of the block before are overwritten.
const PROLOGUE: &str = r#"
set -euo pipefail
qudi() {
    case "$* " in
    *" scene:"*) command qudi "$@" --size 32x48 --force ;;
    *) command qudi "$@" --force ;;
    esac
}
"#;

/// Makes the captures and clips of the pages, and stands for other programs: a video becomes a few frames, a
/// film is not encoded, and a camera delivers noise.
const INPUTS: &str = r#"
mkdir programs clips my-frames
program() {
    printf '#!/bin/sh\n%s\n' "$2" > "programs/$1"
    chmod 755 "programs/$1"
}
program ffmpeg 'case "$*" in
*yuv4mpegpipe*) cat "$INPUTS/clip.y4m" ;;
*image2pipe*) cat "$INPUTS/clip.ppm" ;;
*) for last; do :; done; cat > "${last#file:}" ;;
esac'
program ffplay 'cat > /dev/null'
program camera 'head -c $((7 * 256 * 512 / 8)) /dev/urandom'

qudi simulate scene:text --frames 6 --seed 1 -o burst.npy
gzip -k burst.npy
qudi restore burst.npy --method mle -o frames
qudi restore burst.npy --method mle -o - > clip.y4m
qudi simulate scene:text --sensor swissspad2 --frames 42 --ppp 0.5 --seed 1 -o capture.npy
qudi convert capture.npy -o capture
qudi simulate scene:chart --sensor swissspad2 --frames 100 --ppp-def detected --ppp 0.001 --seed 2 \
    --set sensor.dark=0.0008 -o dark.npy
for clip in dog cat; do
    qudi simulate scene:text --set simulate.scene_seed=${#clip} --frames 5 -o exposed.npy --truth clips/$clip.npy
    cp clips/$clip.npy my-frames/$clip-ppp9_75.npy
done
"#;

/// Writes the photo, and the frames that `ffmpeg` decodes.
fn write_pictures(folder: &Path) {
    let pixel = |x: u32, y: u32, t: u32| {
        image::Rgb([3 * x + 5 * t, 5 * y, x + y].map(|value: u32| value as u8))
    };
    let frame = |t| image::RgbImage::from_fn(48, 32, |x, y| pixel(x, y, t));
    frame(0).save(folder.join("photo.jpg")).unwrap();
    let mut frames = Vec::new();
    for t in 0..6 {
        frames.extend(b"P6\n48 32\n255\n");
        frames.extend(frame(t).as_raw());
    }
    std::fs::write(folder.join("clip.ppm"), frames).unwrap();
    std::fs::write(folder.join("clip.mp4"), "stands for a video").unwrap();
}

/// Returns the blocks of code of a page, each with its language and marks.
fn blocks(text: &str) -> Vec<(String, String)> {
    let (mut blocks, mut open) = (Vec::new(), None);
    for line in text.lines() {
        match (line.trim_start().strip_prefix("```"), &mut open) {
            (Some(info), None) => open = Some((info.to_owned(), String::new())),
            (Some(_), _) => blocks.extend(open.take()),
            (None, Some((_, block))) => writeln!(block, "{line}").unwrap(),
            (None, None) => {}
        }
    }
    blocks
}

/// Runs shell text in a folder, and panics with its errors if a command fails.
fn shell(folder: &Path, inputs: &Path, script: &str, place: &str) {
    let qudi = Path::new(env!("CARGO_BIN_EXE_qudi")).parent().unwrap();
    let path = format!("{}:{}:/usr/bin:/bin", inputs.join("programs").display(), qudi.display());
    let output = Command::new("bash")
        .args(["-c", &format!("{PROLOGUE}{script}")])
        .current_dir(folder)
        .env("PATH", path)
        .env("INPUTS", inputs)
        .env("XDG_CACHE_HOME", inputs.join("no-cache"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{place}: a command of this block failed\n{script}\n{said}");
}

#[cfg(unix)]
#[test]
fn shell_blocks_run_as_documented() {
    let folder = scratch("documentation");
    let inputs = folder.join("inputs");
    std::fs::create_dir(&inputs).unwrap();
    write_pictures(&inputs);
    for set in ["train", "test"] {
        write_cube(&inputs.join(set), "attic/000000", 64, set == "train", still);
    }
    shell(&inputs, &inputs, INPUTS, "the inputs");
    for name in SHELL_PAGES {
        let page = folder.join(name.replace('/', "-"));
        shell(&folder, &inputs, &format!("cp -R inputs '{}'", page.display()), name);
        let text = std::fs::read_to_string(root().join(name)).unwrap();
        for (_, block) in blocks(&text).iter().filter(|(info, _)| info == "sh") {
            shell(&page, &inputs, block, name);
        }
    }
}

#[test]
fn sensor_files_are_read_as_documented() {
    let folder = scratch("documented-sensor");
    let table = |page: &str| {
        let text = std::fs::read_to_string(root().join(page)).unwrap();
        let mut tables = blocks(&text).into_iter().filter(|(info, _)| info == "toml");
        let (table, more) = (tables.next(), tables.next());
        assert!(more.is_none(), "{more:?}");
        table.unwrap().1
    };
    std::fs::write(folder.join("lab.toml"), table("docs/sensors.md")).unwrap();
    let printed = run(&folder, "info lab.toml");
    assert!(printed.contains("lab-a") && printed.contains("16600"), "{printed}");
    let colour = format!("base = \"spad512s\"\n{}", table("docs/colour.md"));
    std::fs::write(folder.join("colour.toml"), colour).unwrap();
    assert!(run(&folder, "info colour.toml").contains("rggb@0,0"));
}

#[test]
fn every_block_is_tested_or_counted() {
    let mut pages = vec![root().join("README.md"), root().join("CONTRIBUTING.md")];
    let mut folders = vec![root().join("docs")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let is_page = path.extension().is_some_and(|extension| extension == "md");
            if path.is_dir() {
                folders.push(path);
            } else if is_page {
                pages.push(path);
            }
        }
    }
    let mut total = 0;
    for page in pages {
        for (info, _) in blocks(&std::fs::read_to_string(&page).unwrap()) {
            let tested: &[&str] = match info.as_str() {
                "sh" => &SHELL_PAGES,
                "python" => &PYTHON_PAGES,
                "toml" => &TABLE_PAGES,
                "sh no-run" => {
                    total += 1;
                    continue;
                }
                "text" => continue, // Output and diagrams.
                _ => &[],
            };
            let is_tested = tested.iter().any(|name| page.ends_with(name));
            assert!(is_tested, "{}: no test reads its blocks of `{info}`", page.display());
        }
    }
    assert_eq!(total, BLOCKS_NOT_RUN, "let a new block run, or count it");
}
