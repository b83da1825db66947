//! The shell blocks of the documentation, run as they are: each page in a folder of its own, with captures,
//! clips and a camera that the test makes. Blocks marked `sh no-run` need a card, data or minutes; a test of
//! the library checks the options of their commands, too.

use super::challenge::{still, write_cube};
use super::support::scratch;
use crate::root;
use assert_cmd::Command;
use std::fmt::Write;
use std::path::Path;

/// Number of blocks in all pages that are marked `sh no-run`.
const BLOCKS_NOT_RUN: usize = 30;

/// Pages with blocks that run.
const PAGES: [&str; 5] =
    ["README.md", "docs/quickstart.md", "docs/methods.md", "docs/sensors.md", "docs/challenge.md"];

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

/// Returns the shell blocks of a page that run, and the number of blocks that do not.
fn blocks(text: &str) -> (Vec<String>, usize) {
    let (mut run, mut not_run, mut open) = (Vec::new(), 0, None);
    for line in text.lines() {
        match (line.trim_start().strip_prefix("```"), &mut open) {
            (Some(info), None) => {
                not_run += usize::from(info == "sh no-run");
                open = Some((info == "sh").then(String::new));
            }
            (Some(_), _) => run.extend(open.take().flatten()),
            (None, Some(Some(block))) => writeln!(block, "{line}").unwrap(),
            (None, _) => {}
        }
    }
    (run, not_run)
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
    for name in PAGES {
        let page = folder.join(name.replace('/', "-"));
        shell(&folder, &inputs, &format!("cp -R inputs '{}'", page.display()), name);
        let text = std::fs::read_to_string(root().join(name)).unwrap();
        for block in blocks(&text).0 {
            shell(&page, &inputs, &block, name);
        }
    }
}

#[test]
fn blocks_that_do_not_run_are_counted() {
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
        let (run, not_run) = blocks(&std::fs::read_to_string(&page).unwrap());
        total += not_run;
        let is_listed = PAGES.iter().any(|name| page.ends_with(name));
        assert!(
            run.is_empty() || is_listed,
            "list {} in PAGES, or mark its blocks",
            page.display()
        );
    }
    assert_eq!(total, BLOCKS_NOT_RUN, "let a new block run, or count it");
}
