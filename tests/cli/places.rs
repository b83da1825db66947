//! No output of any command is one of its inputs, whichever of them is named where.

use crate::support::{npy_bytes, refused, run, scratch};
use std::path::{Path, PathBuf};

/// A command with all its inputs, and options that name an output.
struct Case {
    args: &'static str,
    /// Files that the command reads, named by its arguments or by other inputs.
    inputs: &'static [&'static str],
    /// Options whose value is an output.
    outputs: &'static [&'static str],
}

/// Files that every command which reads a capture is given.
const CAPTURE: &[&str] = &[
    "b.npy",
    "b.npy.json",
    "cal.toml",
    "cal.dark.npy",
    "cal.bad.npy",
    "mask.npy",
    "cfg.toml",
    "map.npy",
];

const CASES: &[Case] = &[
    Case {
        args: "restore b.npy --sensor cal.toml --mask mask.npy -c cfg.toml --weights w.safetensors",
        inputs: CAPTURE,
        outputs: &["-o", "-o o.npy --chi-map", "-o o.npy --side-by-side", "-o o.npy --uncertainty"],
    },
    Case {
        args: "restore b.npy --method qudi --weights w.safetensors",
        inputs: &["w.safetensors"],
        outputs: &["-o", "-o o.npy --chi-map"],
    },
    Case {
        args: "convert b.npy --dcr cal.toml --mask mask.npy",
        inputs: &["b.npy", "b.npy.json", "cal.toml", "cal.dark.npy", "mask.npy"],
        outputs: &["-o"],
    },
    Case {
        args: "calibrate b.npy --sensor cal.toml --mask mask.npy -c cfg.toml",
        inputs: CAPTURE,
        outputs: &["-o"],
    },
    // Next to the sensor file lie two maps.
    Case {
        args: "calibrate new.dark.npy --sensor cal.toml",
        inputs: &["new.toml", "new.dark.npy"],
        outputs: &["-o"],
    },
    Case {
        args: "info b.npy --sensor cal.toml --mask mask.npy -c cfg.toml",
        inputs: CAPTURE,
        outputs: &["--preview"],
    },
    Case {
        args: "look b.npy --sensor cal.toml --mask mask.npy -c cfg.toml",
        inputs: CAPTURE,
        outputs: &["-o"],
    },
    Case {
        args: "eval b.npy --capture --sensor cal.toml --mask mask.npy -c cfg.toml --external a=ext",
        inputs: CAPTURE,
        outputs: &["--csv", "--markdown", "--html", "--export-photons"],
    },
    Case {
        args: "eval fr --sensor cal.toml -c cfg.toml --external a=ext --weights w.safetensors",
        inputs: &["fr", "cal.toml", "cal.dark.npy", "cfg.toml", "ext", "w.safetensors", "map.npy"],
        outputs: &["--csv", "--markdown", "--html", "--export-photons"],
    },
    Case {
        args: "simulate fr --sensor cal.toml -c cfg.toml",
        inputs: &["fr", "fr/frame_000001.png", "cal.toml", "cal.dark.npy", "cfg.toml", "map.npy"],
        outputs: &["-o", "-o s.npy --truth", "-o s.npy --flow", "-o s.npy --preview"],
    },
    Case {
        args: "simulate --from again.npy.json",
        inputs: &["again.npy.json", "fr", "cal.dark.npy"],
        outputs: &["-o", "-o s.npy --truth", "-o s.npy --preview"],
    },
    Case { args: "publish w.safetensors", inputs: &["w.safetensors"], outputs: &["-o"] },
    Case {
        args: "demo --sensor cal.toml --weights w.safetensors",
        inputs: &["cal.toml", "cal.dark.npy", "w.safetensors"],
        outputs: &["-o"],
    },
    Case {
        args: "train mine.toml --data data --init w.safetensors -o run",
        inputs: &["mine.toml", "base.toml", "data/a", "data/a/0.png", "w.safetensors", "cal.toml"],
        outputs: &["--pack", "--bursts"],
    },
    Case {
        args: "train mine.toml --data data --prepare",
        inputs: &["mine.toml", "data/a/0.png", "data/a", "cal.dark.npy"],
        outputs: &["--pack", "--pack p.zip --bursts"],
    },
];

/// Creates a folder with all these files.
fn prepared(name: &str) -> PathBuf {
    let folder = scratch(name);
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).unwrap();
    let map = |value: f32| {
        let bytes: Vec<u8> = (0..32 * 40).flat_map(|_| value.to_le_bytes()).collect();
        npy_bytes("<f4", "(32, 40)", &bytes)
    };
    for (name, value) in [("cal.dark.npy", 0.01), ("map.npy", 0.02), ("new.dark.npy", 0.0)] {
        write(name, &map(value));
    }
    for name in ["mask.npy", "cal.bad.npy"] {
        write(name, &npy_bytes("|u1", "(32, 40)", &[0; 32 * 40]));
    }
    let sensor =
        "base = \"ideal\"\n[defects]\ndark_map = \"cal.dark.npy\"\nbad_pixels = \"cal.bad.npy\"\n";
    write("cal.toml", sensor.as_bytes());
    write("new.toml", b"base = \"ideal\"\n");
    write("cfg.toml", b"[sensor.defects]\ndark_map = \"map.npy\"\n");
    run(&folder, "simulate scene:text --size 32x40 --frames 3 --seed 3 -o b.npy --truth fr -q");
    run(&folder, "simulate fr --sensor cal.toml --seed 3 -o again.npy -q");
    let weights = crate::root().join("crates/qudi-cli/weights/regression.safetensors");
    std::fs::copy(weights, folder.join("w.safetensors")).unwrap();
    std::fs::create_dir(folder.join("ext")).unwrap();
    std::fs::create_dir_all(folder.join("data/a")).unwrap();
    std::fs::copy(folder.join("fr/frame_000000.png"), folder.join("data/a/0.png")).unwrap();
    let recipe =
        std::fs::read_to_string(crate::root().join("crates/qudi-model/recipes/tiny.toml")).unwrap();
    let source = "[[data.source]]\nname = \"films\"\nkind = \"clips\"\nfrom = [\"a\"]\n\n[train]";
    let recipe = recipe.replacen("[train]", source, 1);
    let recipe = recipe.replacen("name = \"qudi-paper\"", "name = \"cal.toml\"", 1);
    write("mine.toml", format!("base = \"base.toml\"\n{recipe}").as_bytes());
    write("base.toml", b"");
    folder
}

fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut list = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            list.extend(contents(&path));
        } else {
            let bytes = std::fs::read(&path).unwrap();
            list.push((path, bytes));
        }
    }
    list.sort();
    list
}

#[test]
fn no_output_of_any_command_is_an_input() {
    let folder = prepared("places-table");
    let before = contents(&folder);
    for Case { args, inputs, outputs } in CASES {
        for (input, output) in inputs.iter().flat_map(|i| outputs.iter().map(move |o| (i, o))) {
            refused(&folder, &format!("{args} {output} {input} -f"), &["output"]);
        }
    }
    // Maps of settings.
    let set = "restore b.npy --method mle --set sensor.defects.dark_map=map.npy -f -o";
    refused(&folder, &format!("{set} map.npy"), &["the output is an input"]);
    assert!(contents(&folder) == before, "an input has changed");
}

#[test]
fn training_keeps_its_recipe_its_start_and_files_of_others() {
    let folder = prepared("places-train");
    let quick = "--device cpu -q --set train.steps=1 --set data.crop=32 --set data.frames=3 \
        --set validation.crop=32 --set validation.frames=3";
    let tiny = crate::root().join("crates/qudi-model/recipes/tiny.toml");
    std::fs::create_dir(folder.join("m")).unwrap();
    std::fs::copy(tiny, folder.join("m/recipe.toml")).unwrap();
    std::fs::create_dir_all(folder.join("m/state/mine")).unwrap();
    std::fs::write(folder.join("m/state/mine/notes"), "mine").unwrap();
    let before = contents(&folder);
    refused(&folder, &format!("train m/recipe.toml -o m -f {quick}"), &["the output is an input"]);
    refused(&folder, &format!("train tiny -o m -f {quick}"), &["this program wrote it"]);
    std::fs::create_dir(folder.join("t")).unwrap();
    std::fs::copy(folder.join("w.safetensors"), folder.join("t/weights.safetensors")).unwrap();
    let init = "--init t/weights.safetensors -o t -f";
    refused(&folder, &format!("train tiny {init} {quick}"), &["the output is an input"]);
    std::fs::remove_dir_all(folder.join("t")).unwrap();
    assert!(contents(&folder) == before);
    // A refused run leaves no folder behind.
    refused(&folder, &format!("train tiny -o new/run --init none {quick}"), &["none"]);
    assert!(!folder.join("new").exists());
    run(&folder, &format!("train tiny -o run {quick}"));
    run(&folder, &format!("train tiny -o run -f {quick}"));
    run(&folder, "train run/recipe.toml -o run --resume -q --device cpu");
    std::fs::write(folder.join("run/state/tensors.safetensors"), "theirs").unwrap();
    refused(&folder, &format!("train tiny -o run -f {quick}"), &["did not write"]);
}
