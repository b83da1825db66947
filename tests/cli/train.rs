//! `qudi train` from recipe to restored frames, and its errors.

use crate::support::{listing, qudi, refused, run, scratch};
use image::{GrayImage, Luma};
use safetensors::SafeTensors;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Settings that shorten `tiny` to seconds.
const QUICK_SETTINGS: &str = "--device cpu -q --set train.steps=4 --set train.checkpoint=2 --set data.crop=32 \
    --set data.frames=3 --set validation.crop=32 --set validation.frames=3 --set validation.every=2";

/// Creates a folder with small recipes for a regression and a diffusion.
fn with_recipes(name: &str) -> PathBuf {
    let folder = scratch(name);
    for (recipe, to) in [("regression", "regression"), ("tiny", "diffusion")] {
        let recipe = crate::root().join(format!("tests/golden/{recipe}.toml"));
        std::fs::copy(recipe, folder.join(format!("{to}.toml"))).unwrap();
    }
    folder
}

/// A run that stops in time ends well, with a state to go on from; the speed of training is measured without
/// a file, and options of methods are refused there.
#[test]
fn training_stops_in_time_and_its_speed_is_measured() {
    let folder = scratch("train-seconds");
    let quick = "--device cpu --set data.crop=32 --set data.frames=3";
    let validation = "--set validation.crop=32 --set validation.frames=3";
    run(&folder, &format!("train tiny -o run --seconds 1 -q {quick} {validation}"));
    assert!(folder.join("run/state").is_dir() && folder.join("run/weights.safetensors").is_file());
    let output = run(&folder, &format!("bench --train tiny --seconds 1 --json {quick}"));
    let found: serde_json::Value = serde_json::from_str(&output).unwrap();
    assert!(found["speed"]["samples_per_second"].as_f64().unwrap() > 0.0);
    assert!(found["speed"]["tflops"].as_f64().unwrap() > 0.0);
    for option in ["--steps 2", "--precision f32", "--weights w.safetensors", "--tile 64"] {
        let words = format!("bench --train tiny {option}");
        let output = qudi(&folder).args(words.split(' ')).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains("cannot be used with"), "{option}: {text}");
    }
}

/// Rounding to bfloat16 without units for it is slow, and said to be.
#[test]
fn bfloat16_without_units_is_noted() {
    let folder = scratch("train-bfloat16");
    for (precision, noted) in [("bf16", true), ("f32", false)] {
        let args = format!(
            "train tiny -o {precision} --set train.steps=1 --set data.crop=32 --set validation.crop=32 \
             --set train.precision={precision} --device cpu"
        );
        let mut command = qudi(&folder);
        let command = command.env("QUDI_KERNELS", "f32").args(args.split_whitespace());
        let output = command.output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{text}");
        assert_eq!(text.contains("--set train.precision=f32 is faster"), noted, "{text}");
    }
}

/// The shipped recipe learns within its first steps.
#[test]
fn tiny_recipe_trains_without_files() {
    const STEPS: usize = 300;
    let folder = scratch("train-tiny");
    run(&folder, &format!("train tiny -o run --set train.steps={STEPS} --device cpu -q"));
    let run_folder = folder.join("run");
    let names = listing(&run_folder);
    let expected = [
        "environment.json",
        "metrics.jsonl",
        "recipe.toml",
        "report.html",
        "samples",
        "state",
        "weights.safetensors",
    ];
    assert_eq!(names, expected);
    let pictures = (0..=STEPS / 100).map(|n| format!("step-{:07}.png", 100 * n));
    let samples: Vec<_> = std::iter::once("loops.json".to_owned()).chain(pictures).collect();
    assert_eq!(listing(&run_folder.join("samples")), samples);
    let metrics = std::fs::read_to_string(run_folder.join("metrics.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> =
        metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let losses: Vec<f64> = lines.iter().filter_map(|line| line["prediction"].as_f64()).collect();
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (first, last) = (mean(&losses[..50]), mean(&losses[STEPS - 100..]));
    assert!(losses.len() == STEPS && last < first - 0.5, "{first} {last}");
    let page = std::fs::read_to_string(run_folder.join("report.html")).unwrap();
    assert!(page.contains("<polyline") && page.contains("data:image/png;base64,"));
    assert!(!page.contains("http:") && !page.contains("https:"), "the report fetches something");
    run(&folder, "simulate scene:text --size 64x64 --frames 11 --seed 3 -o b.npy -q");
    run(&folder, "restore b.npy --weights run/weights.safetensors --steps 1 --device cpu -o r -q");
    assert_eq!(listing(&folder.join("r")).len(), 12); // frames and manifest
    // The mean of all frames has 14.6 and 14.4 dB on such scenes.
    let validations: Vec<_> = lines.iter().filter(|line| line["kind"] == "validation").collect();
    let quality = |line: &serde_json::Value| {
        [0, 1].map(|clip: usize| line["clips"][clip]["psnr_a"].as_f64().unwrap())
    };
    let (first, last) = (quality(validations[0]), quality(validations[STEPS / 100]));
    for (first, last) in first.into_iter().zip(last) {
        assert!(last > first + 3.0 && last > 14.6 + 3.0, "from {first} to {last} dB");
    }
}

/// The pre-denoiser of the paper's system learns from simulated measurements, and several steps use them.
#[test]
fn simulated_measurements_reach_learnt_weights() {
    const NAME: &str = "pre.simulated_in.weight";
    let folder = with_recipes("train-simulated");
    run(&folder, "train diffusion.toml -o run --device cpu -q --set train.steps=150");
    run(&folder, "simulate scene:text --size 64x64 --frames 11 --seed 3 -o b.npy -q");
    let bytes = std::fs::read(folder.join("run/weights.safetensors")).unwrap();
    let values = |bytes: &[u8]| -> Vec<f32> {
        let file = SafeTensors::deserialize(bytes).unwrap();
        let data = file.tensor(NAME).unwrap().data();
        data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    run(
        &folder,
        "train diffusion.toml -o initial --device cpu -q --set train.steps=1 --set train.lr=1e-9 \
         --set train.min_lr=0",
    );
    let initial = values(&std::fs::read(folder.join("initial/weights.safetensors")).unwrap());
    let learnt = values(&bytes);
    let moved = learnt.iter().zip(&initial).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    let moved = (moved / learnt.len() as f32).sqrt();
    assert!(moved > 0.01, "{NAME} moved by {moved}");
    // Without them.
    let mut lesioned = bytes.clone();
    let place =
        SafeTensors::deserialize(&bytes).unwrap().tensor(NAME).unwrap().data().as_ptr_range();
    let first = place.start as usize - bytes.as_ptr() as usize;
    lesioned[first..first + 4 * learnt.len()].fill(0);
    std::fs::write(folder.join("lesioned.safetensors"), lesioned).unwrap();
    for steps in [1, 4] {
        for (name, weights) in [("whole", "run/weights"), ("lesioned", "lesioned")] {
            let output = format!("{name}-{steps}.npy");
            run(
                &folder,
                &format!(
                    "restore b.npy --weights {weights}.safetensors --steps {steps} --device cpu -o {output} -q"
                ),
            );
        }
        let frames =
            |name: &str| std::fs::read(folder.join(format!("{name}-{steps}.npy"))).unwrap();
        assert_eq!(frames("whole") == frames("lesioned"), steps == 1, "{steps} steps");
    }
}

#[test]
fn packs_train_without_the_files() {
    let folder = scratch("train-pack");
    let clip = folder.join("data/films/a");
    std::fs::create_dir_all(&clip).unwrap();
    for t in 0..6 {
        let image = GrayImage::from_fn(48, 40, |x, y| Luma([(4 * (x + t) + 2 * y) as u8]));
        image.save(clip.join(format!("{t}.png"))).unwrap();
    }
    let recipe =
        std::fs::read_to_string(crate::root().join("crates/qudi-model/recipes/tiny.toml")).unwrap();
    let films =
        "[[data.source]]\nname = \"films\"\nkind = \"clips\"\nfrom = [\"films\"]\n\n[train]";
    let recipe = recipe.replacen("[train]", films, 1);
    let recipe =
        recipe.replace("from = [\"scene:dead-leaves\", \"scene:text\"]", "from = [\"films\"]");
    std::fs::write(folder.join("mine.toml"), recipe).unwrap();
    run(
        &folder,
        "train mine.toml --data data --pack p.zip --prepare -q --set data.crop=32 --set data.frames=3",
    );
    std::fs::remove_dir_all(folder.join("data")).unwrap();
    run(&folder, &format!("train mine.toml --pack p.zip -o run {QUICK_SETTINGS}"));
    let metrics = std::fs::read_to_string(folder.join("run/metrics.jsonl")).unwrap();
    assert!(metrics.contains("films-a"), "validated on the pack's clip");
    refused(&folder, "train mine.toml -o other", &["--data"]);
    assert!(!folder.join("other/weights.safetensors").exists());
}

#[test]
fn runs_resume_and_are_never_lost() {
    let folder = with_recipes("train-resume");
    run(&folder, &format!("train diffusion.toml -o run {QUICK_SETTINGS}"));
    refused(
        &folder,
        &format!("train diffusion.toml -o run {QUICK_SETTINGS}"),
        &["--resume", "--force"],
    );
    refused(
        &folder,
        &format!("train diffusion.toml -o nothing --resume {QUICK_SETTINGS}"),
        &["no state"],
    );
    // A longer run: its recipe with one key changed.
    run(&folder, "train -o run --resume --device cpu -q --set train.steps=6");
    let metrics = std::fs::read_to_string(folder.join("run/metrics.jsonl")).unwrap();
    assert_eq!(metrics.lines().filter(|line| line.contains("\"kind\":\"step\"")).count(), 6);
    run(&folder, &format!("train diffusion.toml -o run --force {QUICK_SETTINGS}"));
    let metrics = std::fs::read_to_string(folder.join("run/metrics.jsonl")).unwrap();
    assert_eq!(metrics.lines().filter(|line| line.contains("\"kind\":\"step\"")).count(), 4);
    // A stage that starts from the weights of another run.
    run(
        &folder,
        &format!("train diffusion.toml -o stage --init run/weights.safetensors {QUICK_SETTINGS}"),
    );
    let wide = format!(
        "train diffusion.toml -o wide --init run/weights.safetensors --set network.unet.width=16 {QUICK_SETTINGS}"
    );
    refused(&folder, &wide, &["other values of network.unet.width"]);
    let other =
        format!("train regression.toml -o other --init run/weights.safetensors {QUICK_SETTINGS}");
    refused(&folder, &other, &["weights of a diffusion"]);
}

/// The lock is the system's: it ends with the process that holds it.
#[test]
fn a_second_training_in_a_folder_is_refused() {
    let folder = with_recipes("train-lock");
    let train = format!("train diffusion.toml -o run {QUICK_SETTINGS}");
    run(&folder, &train);
    let held = std::fs::File::open(folder.join("run")).unwrap();
    held.lock().unwrap();
    refused(&folder, &format!("{train} -f"), &["another run is writing"]);
    refused(&folder, "train -o run --resume --device cpu -q", &["another run is writing"]);
    drop(held);
    run(&folder, &format!("{train} -f"));
}

/// The refinement learns first; the uncertainty is learnt without changing the frames.
#[test]
fn regression_learns_in_parts() {
    let folder = with_recipes("train-regression");
    let train = |to: &str, parts: &str, init: &str| {
        run(
            &folder,
            &format!(
                "train regression.toml -o {to} --set train.learns={parts} {init} {QUICK_SETTINGS}"
            ),
        );
    };
    train("first", "[\"refinement\"]", "");
    train("second", "[\"pre\",\"uncertainty\"]", "--init first/weights.safetensors");
    train("uncertain", "[\"uncertainty\"]", "--init second/weights.safetensors");
    run(&folder, "simulate scene:text --size 48x32 --frames 3 --sensor qudi-paper -o b.npy -q");
    let restored = |name: &str| {
        let to = format!("{name}.npy");
        let weights = format!("{name}/weights.safetensors");
        run(&folder, &format!("restore b.npy --weights {weights} --device cpu -o {to} -q"));
        let npy = std::fs::read(folder.join(to)).unwrap();
        let pixels = npy[npy.len() - 3 * 48 * 32 * 4..].chunks_exact(4);
        pixels.map(|value| f32::from_le_bytes(value.try_into().unwrap())).collect::<Vec<_>>()
    };
    let [first, second, same] = ["first", "second", "uncertain"].map(restored);
    assert!(first != second);
    // Up to rounding in the average of constant weights.
    assert!(second.into_iter().zip(same).all(|(a, b)| (a - b).abs() < 1e-5));
    let report = std::fs::read_to_string(folder.join("uncertain/report.html")).unwrap();
    assert!(report.contains("predicted uncertainty"));
}

#[test]
fn draws_all_bursts_before_training() {
    let folder = with_recipes("train-draw");
    let parts =
        format!("{QUICK_SETTINGS} --set train.crops={{bursts=5,cached_frames=3,frames=3,side=16}}");
    run(&folder, &format!("train regression.toml --bursts kept --prepare --workers 2 {parts}"));
    let names: Vec<_> = (0..5).map(|number| format!("1-{number:06}.safetensors")).collect();
    assert_eq!(listing(&folder.join("kept")), names);
    // Existing bursts are kept; missing ones are drawn again, the same.
    let path = |number: usize| folder.join("kept").join(&names[number]);
    let [before, kept] = [3, 4].map(|number| std::fs::read(path(number)).unwrap());
    let written = |number: usize| std::fs::metadata(path(number)).unwrap().modified().unwrap();
    let at = written(4);
    std::fs::remove_file(path(3)).unwrap();
    run(&folder, &format!("train regression.toml --bursts kept --prepare {parts}"));
    assert!(std::fs::read(path(3)).unwrap() == before && written(4) == at);
    run(&folder, &format!("train regression.toml --bursts kept -o run {parts}"));
    assert!(std::fs::read(path(4)).unwrap() == kept);
    refused(&folder, "train regression.toml --bursts kept --prepare", &["train.crops"]);
    let other = format!("train regression.toml --bursts kept --prepare {parts} --set data.crop=40");
    refused(&folder, &other, &["drawn with other"]);
}

#[test]
fn rejects_impossible_recipes_and_folders() {
    let folder = scratch("train-refused");
    for (args, words) in [
        ("train -o run", ["no recipe"].as_slice()),
        ("train huge -o run", &["huge", "tiny"]),
        ("train tiny -o run --set train.stepz=3", &["stepz"]),
        ("train tiny -o run --set train.steps", &["KEY=VALUE"]),
        ("train tiny -o run --device cuda:7", &["cuda:7"]),
        ("train tiny -o run --init none.safetensors", &["none.safetensors"]),
        ("train emvd -o run", &["--data"]),
        ("train emvd -o run --data .", &["cups"]),
        ("train paper -o run --data . --backbones .", &["vgg16"]),
        (
            "train tiny -o run --set train.loss.term=lpips-vgg --set train.loss.perceptual=0.3 --backbones .",
            &["vgg16"],
        ),
    ] {
        refused(&folder, args, words);
    }
    std::fs::write(folder.join("taken"), "a file").unwrap();
    refused(&folder, "train tiny -o taken", &["taken"]);
}

/// Stages continue from each other, skip finished ones, and change only the parts that they name.
#[test]
fn stages_train_one_after_the_other() {
    let folder = with_recipes("train-stages");
    let mut recipe = std::fs::read_to_string(folder.join("regression.toml")).unwrap();
    recipe.push_str(
        "
[[stage]]
name = \"first\"
changes = { \"train.learns\" = [\"refinement\"] }

[[stage]]
name = \"second\"

[[stage]]
name = \"rest\"
changes = { \"train.learns\" = [\"uncertainty\"], \"train.seed\" = 7 }
",
    );
    std::fs::write(folder.join("stages.toml"), recipe).unwrap();
    run(&folder, &format!("train stages.toml -o run {QUICK_SETTINGS}"));
    let names = listing(&folder.join("run"));
    let stages = ["1-first", "2-second", "3-rest"];
    let files = ["environment.json", "recipe.toml", "weights.safetensors"];
    assert_eq!(names, [&stages[..], &files].concat());
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
    let whole = read("run/weights.safetensors");
    // The weights hold the recipes of all stages, with every switch.
    let said = run(&folder, "info run/weights.safetensors");
    for words in ["recipe of stage 3", "\"refinement\"", "\"uncertainty\"", "train.timesteps = "] {
        assert!(said.contains(words), "no {words} in\n{said}");
    }
    assert!(whole == read("run/3-rest/weights.safetensors"));
    // Only the uncertainty has learnt in the last stage.
    let tensors = |name: &str| {
        let bytes = read(name);
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let tensors = file.tensors().into_iter();
        tensors.map(|(name, view)| (name, view.data().to_vec())).collect::<BTreeMap<_, _>>()
    };
    let (before, after) =
        (tensors("run/2-second/weights.safetensors"), tensors("run/3-rest/weights.safetensors"));
    assert_eq!(before.len(), after.len());
    let changed = after.iter().filter(|(name, values)| before[*name] != **values);
    let changed: Vec<&String> = changed.map(|(name, _)| name).collect();
    assert!(
        !changed.is_empty() && changed.iter().all(|n| n.starts_with("uncertainty.")),
        "{changed:?}"
    );
    // Killed in the second stage: the rest comes out the same.
    std::fs::remove_dir_all(folder.join("run/3-rest")).unwrap();
    std::fs::remove_file(folder.join("run/weights.safetensors")).unwrap();
    std::fs::remove_dir_all(folder.join("run/2-second/state")).unwrap();
    run(&folder, "train -o run --resume --device cpu -q");
    assert!(whole == read("run/weights.safetensors"));
    refused(
        &folder,
        &format!("train stages.toml -o run {QUICK_SETTINGS}"),
        &["--resume", "--force"],
    );
    let draws = &["--prepare", "each stage draws its own"];
    refused(&folder, "train stages.toml --bursts b --prepare", draws);
    refused(&folder, "train stages.toml --prepare", &["nothing to prepare", "--pack"]);
    let changed = "train -o run --resume --device cpu -q --set train.lr=2e-3";
    refused(&folder, changed, &["train.lr"]);
    // A refused run loses nothing.
    refused(
        &folder,
        &format!("train stages.toml -o run --force --init none {QUICK_SETTINGS}"),
        &["none"],
    );
    assert!(folder.join("run/2-second/state").exists());
    let recipe = std::fs::read_to_string(folder.join("stages.toml")).unwrap();
    for (good, bad) in [("\"first\"", "\"../first\""), ("train.seed", "train.seeds")] {
        std::fs::write(folder.join("bad.toml"), recipe.replace(good, bad)).unwrap();
        refused(&folder, &format!("train bad.toml -o bad {QUICK_SETTINGS}"), &["stage"]);
    }
    let learns = format!("train tiny -o other {QUICK_SETTINGS} --set");
    refused(&folder, &format!("{learns} train.learns=[\"unet\"]"), &["train.learns"]);
    refused(&folder, &format!("{learns} train.learns=[\"eyes\"]"), &["eyes"]);
    refused(&folder, &format!("{learns} train.ablate=[\"eyes\"]"), &["train.ablate"]);
}
