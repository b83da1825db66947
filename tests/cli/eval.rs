//! `qudi eval`: the same photons for all methods, thresholds, exports.

use crate::support::{listing, qudi, refused, run, scratch};
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
            .args([
                "restore",
                "--method",
                "mle",
                &format!("photons/{name}.npy"),
                "-o",
                &format!("theirs/{name}.npy"),
            ])
            .args("--mask none --ppp 9.75 -q".split(' '))
            .assert()
            .success();
    }
    let both = eval(&folder, "clips --method mle --ppp 9.75 --external theirs=theirs");
    // Only times differ.
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
    let row = &found["rows"][0];
    assert!(row["peak_mib"].is_number() == cfg!(target_os = "linux"), "{row}");
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
fn classical_methods_beat_the_average_under_motion() {
    let folder = scratch("eval-classical");
    let methods = "mle,transform-denoise,bm3d,qbp,qbp-bm3d";
    let clip = "--size 80x96 --frames 11 --ppp 3 --seed 1 --truth clip.npy -o burst.npy -q";
    qudi(&folder).args("simulate scene:text".split(' ')).args(clip.split(' ')).assert().success();
    let found = eval(&folder, &format!("clip.npy --ppp 9.75 --method {methods}"));
    let psnr = |row: usize| found["rows"][row]["psnr_a"]["all"]["mean"].as_f64().unwrap();
    for row in 1..5 {
        assert!(
            psnr(row) > psnr(0),
            "{}: {} dB, mle {} dB",
            found["rows"][row]["method"],
            psnr(row),
            psnr(0)
        );
    }
}

#[test]
fn report_is_one_self_contained_file() {
    let folder = scratch("eval-html");
    eval(&folder, "scene:dead-leaves --ppp 3.25,26 --frames 11 --html report.html");
    let page = std::fs::read_to_string(folder.join("report.html")).unwrap();
    for part in
        ["<table>", "<svg", "polyline", "dead-leaves", "type=\"range\"", "\"name\":\"truth\""]
    {
        assert!(page.contains(part), "{part}");
    }
    for fetched in ["http://", "https://", "src=\"/", "url("] {
        assert!(!page.contains(fetched), "{fetched}");
    }
    // Flicker is measured along the true flow of synthetic scenes.
    let found = eval(&folder, "scene:dead-leaves --ppp 26 --frames 11");
    let flicker = |row: usize| found["rows"][row]["flicker"].as_f64().unwrap();
    assert!(flicker(0) > 0.0 && flicker(1) > flicker(0), "a shorter mean is noisier: {found}");
}

#[test]
fn quiver_protocol_scores_the_middle_of_every_window() {
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

/// The flow of a recorded clip is estimated, with about the same flicker as along the true flow.
#[test]
fn recorded_clips_flicker_along_an_estimated_flow() {
    let folder = scratch("eval-flow");
    qudi(&folder)
        .args(
            "simulate scene:dead-leaves --size 256x256 --frames 6 --seed 1 -o x.npy -q".split(' '),
        )
        .args(["--truth", "clip.npy"])
        .assert()
        .success();
    let known = eval(&folder, "scene:dead-leaves --ppp 9.75 --frames 6 --method average,mle");
    let recorded = eval(&folder, "clip.npy --ppp 9.75 --markdown t.md --method average,mle");
    for row in 0..2 {
        let (known, recorded) = (&known["rows"][row], &recorded["rows"][row]);
        assert_eq!((&known["flow"], &recorded["flow"]), (&"true".into(), &"estimated".into()));
        let flicker = |row: &Value| row["flicker"].as_f64().unwrap();
        let ratio = flicker(recorded) / flicker(known);
        assert!((0.7..1.4).contains(&ratio), "{} {}", flicker(recorded), flicker(known));
    }
    let table = std::fs::read_to_string(folder.join("t.md")).unwrap();
    assert!(table.contains("flicker (estimated flow)"), "{table}");
}

#[test]
fn evaluates_a_capture_without_truth() {
    let folder = scratch("eval-capture");
    qudi(&folder)
        .args("simulate scene:dead-leaves --size 48x64 --frames 40 --seed 2 -o c.npy -q".split(' '))
        .assert()
        .success();
    let files = "--html r.html --csv f.csv --markdown t.md";
    let found = eval(&folder, &format!("c.npy --capture --frames 20 {files}"));
    for row in found["rows"].as_array().unwrap() {
        let chi_square = row["chi_square"].as_f64().unwrap();
        assert!((0.3..3.0).contains(&chi_square), "{row}");
        assert!(row["seconds_per_frame"].is_number());
        assert_eq!(row["clips"][0]["frames"].as_array().unwrap().len(), 20);
        for truth in ["psnr_a", "psnr", "ssim", "ssim_g", "flicker", "flow"] {
            assert!(row.get(truth).is_none(), "{truth} is absent, not zero: {row}");
        }
    }
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    assert!(!read("t.md").contains("psnr") && read("t.md").contains("chi-square"));
    assert_eq!(read("f.csv").lines().count(), 1 + 2 * 20);
    assert!(read("f.csv").lines().nth(1).unwrap().contains(",0,,,,,"), "empty, not zero");
    let page = read("r.html");
    assert!(
        page.contains("\"name\":\"counts\"") && page.contains("mle over 11 frames: chi-square")
    );
    assert!(!page.contains("\"name\":\"truth\""));
    for refused in [
        "c.npy",
        "c.npy --capture --min-psnr 3",
        "c.npy --capture --protocol quiver",
        "c.npy --capture --ppp 3,4",
        "c.npy --capture --frames 0",
        "scene:text --sum 3",
        "scene:text --gain 3",
        "scene:text --exposure 0",
    ] {
        qudi(&folder).arg("eval").args(refused.split(' ')).assert().code(2);
    }
}

#[test]
fn parts_of_the_clips_give_the_figures_of_the_whole() {
    let folder = scratch("eval-shard");
    let clips = folder.join("clips");
    std::fs::create_dir(&clips).unwrap();
    for seed in ["1", "2", "3"] {
        let scene =
            "simulate scene:text --size 32x32 --frames 5 --ppp 3 --seed 1 -q -f -o ../x.npy";
        let truth = format!("{seed}.npy");
        qudi(&clips)
            .args(scene.split(' '))
            .args(["--scene-seed", seed, "--truth", &truth])
            .assert()
            .success();
    }
    let scores = |shard: &str| {
        let result = eval(&folder, &format!("clips --method average --ppp 9.75{shard}"));
        let clips = result["rows"][0]["clips"].as_array().unwrap().clone();
        clips.into_iter().map(|clip| clip["frames"].to_string()).collect::<Vec<_>>()
    };
    let parts = [scores(" --shard 1/2"), scores(" --shard 2/2")];
    assert_eq!(parts.concat(), scores(""));
    assert_eq!(parts.map(|part| part.len()), [1, 2]);
    // Joined, all figures but times equal one run's, to the last bit.
    let timeless = |mut document: Value| {
        for row in document["rows"].as_array_mut().unwrap() {
            let parts = row["clips"].as_array_mut().unwrap().iter_mut();
            for part in parts.map(|clip| clip.as_object_mut().unwrap()) {
                part.retain(|key, _| !["seconds_per_frame", "peak_mib"].contains(&key.as_str()));
            }
            row.as_object_mut()
                .unwrap()
                .retain(|key, _| !["seconds_per_frame", "peak_mib"].contains(&key.as_str()));
        }
        document.to_string()
    };
    let args = "clips --method average,mle --ppp 9.75";
    for part in ["1", "2"] {
        let document = run(&folder, &format!("eval {args} --json --shard {part}/2"));
        std::fs::write(folder.join(format!("{part}.json")), document).unwrap();
    }
    let joined = eval(&folder, &format!("{args} --join 1.json 2.json"));
    assert_eq!(timeless(joined), timeless(eval(&folder, args)));
    crate::support::refused(
        &folder,
        &format!("eval {args} --join 1.json 1.json"),
        &["another part"],
    );
    let none = "eval clips --method average --shard 1/9";
    crate::support::refused(&folder, none, &["--shard"]);
}

#[test]
fn appearance_is_measured_where_it_is_asked_for() {
    let folder = scratch("eval-appearance");
    let eval =
        "eval scene:text --size 64x64 --frames 3 --ppp 5 --method average --force --csv f.csv";
    let header = |args: &str| {
        run(&folder, &format!("{eval}{args}"));
        let csv = std::fs::read_to_string(folder.join("f.csv")).unwrap();
        csv.lines().next().unwrap().to_owned()
    };
    let names = ["gmsd", "ssimulacra2", "butteraugli", "detail_flat", "detail_textured"];
    let (without, with) = (header(""), header(" --appearance"));
    assert!(names.iter().all(|name| with.contains(name) && !without.contains(name)), "{with}");
    let small = eval.replace("64x64", "16x64");
    refused(&folder, &format!("{small} --appearance"), &["--appearance", "32 x 32"]);
}

/// Every number of steps has its row; their additions are measured against the fewest steps.
#[test]
fn numbers_of_steps_are_compared_in_one_run() {
    let folder = scratch("eval-steps");
    let scored = eval(
        &folder,
        "scene:text --size 64x64 --frames 4 --ppp 5 --method average,qudi-regression,qudi-diffusion --steps 2,1 --device cpu --appearance --html r.html --csv r.csv --markdown r.md",
    );
    let rows = scored["rows"].as_array().unwrap();
    let steps: Vec<_> = rows.iter().map(|row| row["steps"].as_u64()).collect();
    assert_eq!(steps, [None, None, Some(1), Some(2)]);
    assert!(rows[..3].iter().all(|row| row["added_over_missed"].is_null()));
    let added = rows[3]["added_over_missed"].as_array().unwrap();
    assert_eq!(added.len(), 5);
    assert!(
        added.iter().all(|ratio| (0.001..10.0).contains(&ratio.as_f64().unwrap())),
        "{added:?}"
    );
    // A run of two steps alone gives the same frames.
    let alone = eval(
        &folder,
        "scene:text --size 64x64 --frames 4 --ppp 5 --method qudi-diffusion --steps 2 --device cpu --appearance",
    );
    assert_eq!(alone["rows"][0]["psnr_a"], rows[3]["psnr_a"]);
    assert!(alone["rows"][0]["steps"].is_null());
    // The regression predicts its uncertainty; one sample does not.
    let of = |row: &Value| row["error_over_sigma_textured"]["all"]["mean"].as_f64();
    assert!(
        of(&rows[1]).is_some_and(|ratio| (0.1..10.0).contains(&ratio)) && of(&rows[2]).is_none()
    );
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    assert!(read("r.csv").starts_with("method,steps,ppp,clip,frame,"), "{}", read("r.csv"));
    assert!(read("r.md").contains("What more steps added"));
    let page = read("r.html");
    assert!(
        page.contains("qudi-diffusion, 2 steps") && page.contains("Perception against distortion")
    );
    refused(
        &folder,
        "eval scene:text --size 64x64 --frames 4 --ppp 5 --method mle --steps 1,2",
        &["--steps", "method qudi-diffusion"],
    );
}

#[test]
fn clips_are_chosen_by_name() {
    let folder = scratch("eval-clips");
    std::fs::create_dir(folder.join("clips")).unwrap();
    for (name, seed) in [("a", 1), ("b", 2), ("c", 3)] {
        let args = format!(
            "simulate scene:text --size 32x32 --frames 3 --ppp 3 -o x.npy --scene-seed {seed}"
        );
        run(&folder, &format!("{args} --truth clips/{name}.npy -q -f"));
    }
    let scored = eval(&folder, "clips --clips c,a --ppp 5 --method average");
    assert_eq!(scored["clips"], serde_json::json!(["a", "c"]));
    let all = eval(&folder, "clips --ppp 5 --method average");
    let of = |scored: &Value, n: usize| scored["rows"][0]["clips"][n].clone();
    let timeless = |mut score: Value| {
        score.as_object_mut().unwrap().retain(|key, _| key == "clip" || key == "frames");
        score
    };
    assert_eq!(timeless(of(&scored, 1)), timeless(of(&all, 2)), "the same photons");
    refused(&folder, "eval clips --clips d --ppp 5", &["`d`", "--clips", "a, b, c"]);
}

/// Writes weights of a small EMVD under its authors' keys.
fn emvd_weights(folder: &Path) {
    use qudi_baselines::emvd::Emvd;
    use safetensors::tensor::{Dtype, TensorView};
    let network = Emvd::zeros(4, &burn::tensor::Device::flex());
    let tensors: Vec<_> = qudi_layers::parameter_shapes(&network)
        .into_iter()
        .map(|(name, shape)| {
            let count: usize = shape.iter().product();
            let value = |i: usize| 0.4 * (((i * 37 + name.len()) % 17) as f32 / 17.0 - 0.4);
            let bytes: Vec<u8> = (0..count).flat_map(|i| value(i).to_le_bytes()).collect();
            (name, shape, bytes)
        })
        .collect();
    let views = tensors.iter().map(|(name, shape, bytes)| {
        (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap())
    });
    let file = folder.join("emvd.safetensors");
    safetensors::serialize_to_file(views.collect::<Vec<_>>(), None, &file).unwrap();
}

#[test]
fn learned_methods_run_with_the_weights_that_are_named() {
    let folder = scratch("eval-learned");
    emvd_weights(&folder);
    let clip = "scene:text --size 32x48 --frames 4 --ppp 3.25";
    let weights = "--weights emvd=emvd.safetensors";
    let scored = eval(&folder, &format!("{clip} --method emvd,average {weights}"));
    let [emvd, average] = [0, 1].map(|row| scored["rows"][row]["psnr_a"]["all"]["mean"].as_f64());
    assert!(emvd.is_some_and(f64::is_finite) && emvd != average, "{emvd:?} {average:?}");
    let table =
        run(&folder, &format!("eval {clip} --table1 {weights} --device cpu --markdown t.md"));
    for part in ["20.02", "no weights: --weights quiver=FILE", "I2-2000FPS"] {
        assert!(table.contains(part), "{part}: {table}");
    }
    assert!(!table.contains("no weights: --weights emvd"), "{table}");
    assert!(
        std::fs::read_to_string(folder.join("t.md")).unwrap().contains("| emvd | 3.25 | 20.02")
    );
    let info = run(&folder, "info emvd.safetensors");
    assert!(info.contains("emvd") && info.contains("4 channels"), "{info}");
    run(&folder, "simulate scene:text --size 32x48 --frames 4 --ppp 3 -o b.npy -q");
    run(&folder, &format!("restore b.npy --method emvd {weights} -o r.npy -q"));
    // Only its weights are bundled.
    run(&folder, "restore b.npy --method emvd -o built-in.npy -q");
    let frames = ["r.npy", "built-in.npy"].map(|file| std::fs::read(folder.join(file)).unwrap());
    assert_ne!(frames[0], frames[1]);
    for (args, words) in [
        ("restore b.npy --method quiver -o x.npy", &["quiver", "--weights quiver=FILE"][..]),
        ("restore b.npy --method rvrt --weights rvrt=emvd.safetensors -o x.npy", &["not of rvrt"]),
        ("restore b.npy --method mle --weights emvd=emvd.safetensors -o x.npy", &["not asked for"]),
        (
            "restore b.npy --method emvd --steps 3 --weights emvd=emvd.safetensors -o x.npy",
            &["--steps"],
        ),
        ("restore b.npy --weights rvrt= -o x.npy", &[]),
    ] {
        if words.is_empty() {
            assert!(!qudi(&folder).args(args.split(' ')).output().unwrap().status.success());
        } else {
            refused(&folder, args, words);
        }
    }
}
