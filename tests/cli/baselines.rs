//! Learned methods of others from recipe to restored frames and tables.

use crate::support::{listing, refused, run, scratch};
use std::path::PathBuf;

/// Settings that shorten a training to seconds.
const QUICK_SETTINGS: &str = "--device cpu -q --set network.width=4 --set train.steps=4 --set train.checkpoint=2 \
    --set data.crop=32 --set data.frames=4 --set validation.crop=32 --set validation.frames=3 \
    --set validation.every=2 --set validation.ppp=[3.25] --set train.lr=1e-2 --set train.warmup=1";

/// Creates a folder with the recipe of EMVD on procedural scenes alone.
fn with_recipe(name: &str) -> PathBuf {
    let folder = scratch(name);
    let text =
        std::fs::read_to_string(crate::root().join("crates/qudi-baselines/recipes/emvd.toml"))
            .unwrap();
    let scenes = "[[data.source]]\nname = \"scenes\"\nkind = \"scenes\"\nfrom = [\"dead-leaves\", \"text\"]\n";
    let text = text.replace("[train]", &format!("{scenes}speed = 5.0\n\n[train]"));
    let text = text.replace("[validation]", "[validation]\nfrom = [\"scene:text\"]");
    std::fs::write(folder.join("scenes.toml"), text).unwrap();
    folder
}

#[test]
fn emvd_trains_resumes_restores_and_says_what_it_is() {
    let folder = with_recipe("train-emvd");
    run(&folder, &format!("train scenes.toml -o run {QUICK_SETTINGS}"));
    let names = listing(&folder.join("run"));
    let files = ["environment.json", "metrics.jsonl", "recipe.toml", "report.html", "samples"];
    assert_eq!(names, [&files[..], &["state", "weights.safetensors"]].concat());
    let pictures = listing(&folder.join("run/samples"));
    assert!(pictures.len() == 4 && pictures[0] == "loops.json", "{pictures:?}");
    let metrics = std::fs::read_to_string(folder.join("run/metrics.jsonl")).unwrap();
    let step = metrics.lines().find(|line| line.contains("\"step\"")).unwrap();
    assert!(metrics.contains("\"transforms\":") && !metrics.contains("\"prediction\":"), "{step}");
    let report = std::fs::read_to_string(folder.join("run/report.html")).unwrap();
    assert!(report.contains("transforms") && report.contains("data:image/png;base64,"));
    // Two steps, then the rest from the state.
    run(&folder, &format!("train scenes.toml -o parts {QUICK_SETTINGS} --set train.steps=2"));
    let text = std::fs::read_to_string(folder.join("parts/recipe.toml")).unwrap();
    assert!(text.contains("method = \"emvd\"") && !text.contains("[train.loss]"), "{text}");
    run(&folder, "train -o parts --resume --device cpu -q --set train.steps=4");
    assert!(listing(&folder.join("parts")).contains(&"weights.safetensors".to_owned()));

    let info = run(&folder, "info run/weights.safetensors");
    for part in ["emvd", "4 channels", "4 steps on scenes", "qudi-paper", "2 to 30 photons", "MIT"]
    {
        assert!(info.contains(part), "{part}: {info}");
    }
    run(&folder, "simulate scene:text --size 32x32 --frames 5 --seed 3 -o b.npy -q");
    let weights = "--weights emvd=run/weights.safetensors --device cpu";
    run(&folder, &format!("restore b.npy --method emvd {weights} -o r.npy -q"));
    let clip = "eval scene:text --size 32x32 --frames 5 --seed 3 --ppp 3.25";
    let table = run(&folder, &format!("{clip} --method emvd,average {weights}"));
    assert!(table.contains("emvd (trained here: 4 channels, 4 steps)"), "{table}");
    let table = run(&folder, &format!("{clip} --table1 {weights}"));
    assert!(table.contains("trained here: 4 channels, 4 steps"), "{table}");

    let small = format!("restore b.npy --method emvd {weights} --tile 32 -o s");
    refused(&folder, &small, &["tiles of 32 pixels", "emvd needs at least 64"]);

    // They have not learnt counts of one bit.
    run(
        &folder,
        "simulate scene:text --size 32x32 --sensor swissspad2 --frames 5 --ppp 1 -o s.npy -q",
    );
    let other = ["swissspad2", "trained for qudi-paper"];
    refused(&folder, &format!("restore s.npy --method emvd {weights} -o s"), &other);
    let binary = "--sensor swissspad2";
    refused(&folder, &format!("{clip} --method emvd {binary} {weights}"), &other);
    let table = run(&folder, &format!("{clip} --table1 {binary} {weights}"));
    let note = |method: &str| {
        let mut lines = table.lines().filter(|line| line.trim_start().starts_with(method));
        lines.any(|line| line.contains("the weights were trained for qudi-paper"))
    };
    assert!(note("emvd") && !note("qbp-bm3d"), "{table}");

    // Starts from these weights, in stages, and on bursts that are drawn first.
    run(
        &folder,
        &format!("train scenes.toml -o again --init run/weights.safetensors {QUICK_SETTINGS}"),
    );
    let wide = "--set network.width=8";
    let wide =
        format!("train scenes.toml -o wide --init run/weights.safetensors {QUICK_SETTINGS} {wide}");
    refused(&folder, &wide, &["4 channels", "8 channels"]);
    refused(&folder, "publish run/weights.safetensors -o p.safetensors", &["emvd", "as they are"]);
    let other = format!("train tiny -o other --init run/weights.safetensors {QUICK_SETTINGS}");
    refused(&folder, &other.replace("--set network.width=4 ", ""), &["another program"]);
    let crops = "--set train.crops={bursts=2,cached_frames=4,frames=4,side=16}";
    run(&folder, &format!("train scenes.toml --bursts kept --prepare {QUICK_SETTINGS} {crops}"));
    assert_eq!(listing(&folder.join("kept")).len(), 2);
    let mut recipe = std::fs::read_to_string(folder.join("scenes.toml")).unwrap();
    recipe.push_str(
        "\n[[stage]]\nname = \"coarse\"\n\n[[stage]]\nname = \"fine\"\nchanges = { \"train.lr\" = 1e-4 }\n",
    );
    std::fs::write(folder.join("stages.toml"), recipe).unwrap();
    let quick = QUICK_SETTINGS.replace("--set train.lr=1e-2 ", "");
    run(&folder, &format!("train stages.toml -o stages {quick}"));
    let names = listing(&folder.join("stages"));
    let files = ["environment.json", "recipe.toml", "weights.safetensors"];
    assert_eq!(names, [&["1-coarse", "2-fine"][..], &files].concat());
}

#[test]
fn names_of_baselines_are_names_of_recipes() {
    let folder = scratch("train-baseline-names");
    for name in ["quiver", "emvd", "flornn", "spk2imgnet", "memdeblur", "rvrt", "student-teacher"] {
        refused(&folder, &format!("train {name} -o run"), &["--data"]);
    }
    for (args, words) in [
        ("train huge -o run", ["huge", "student-teacher"].as_slice()),
        ("train emvd -o run --set train.loss.pre=1", &["train.loss.pre"]),
        ("train emvd -o run --set train.learns=[\"pre\"]", &["train.learns", "emvd"]),
        ("train emvd -o run --set network.width=0", &["from 1 to 4096"]),
        ("train emvd -o run --set validation.steps=1", &["validation.steps"]),
        ("train flornn -o run --set data.frames=9", &["11 or more"]),
    ] {
        refused(&folder, args, words);
    }
}
