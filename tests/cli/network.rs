//! The networks on the command line: weights, devices, options and errors.

use crate::support::{listing, qudi, refused, run, scratch};
use burn::tensor::Device;
use qudi_core::atomic_file::Overwrite;
use qudi_layers::Provenance;
use qudi_model::checkpoint::{Description, Precision, Sampling, save};
use qudi_model::config::NetworkConfig;
use qudi_model::init_parameters;
use std::path::{Path, PathBuf};

/// Creates a folder with a burst and weights of the smallest network, a diffusion.
fn prepared(name: &str) -> PathBuf {
    let folder = scratch(name);
    qudi(&folder)
        .args(
            "simulate scene:text --size 32x40 --frames 13 --ppp 9.75 --seed 3 -o b.npy -q"
                .split(' '),
        )
        .assert()
        .success();
    weights(&folder.join("w.safetensors"), 0.005);
    folder
}

fn weights(path: &Path, value: f32) {
    let text = std::fs::read_to_string(crate::root().join("tests/golden/tiny.toml")).unwrap();
    let network = NetworkConfig::parse(&text, "tiny").unwrap();
    let NetworkConfig::Diffusion(sizes) = &network else { panic!("a diffusion") };
    let module = sizes.init(1, &Device::flex());
    let module = init_parameters(module, |_, shape| vec![value; shape.iter().product()]);
    let description = Description {
        preset: Some("tiny".into()),
        network,
        window: 11,
        passes: 1,
        provenance: Provenance {
            program: "qudi test".into(),
            sensors: vec!["qudi-paper".into()],
            ppp: [3.25, 26.0],
            data: vec!["nothing".into()],
            steps: 0,
            commit: None,
            licence: "MIT OR Apache-2.0".into(),
            recipes: Vec::new(),
        },
        sampling: Some(Sampling::default()),
    };
    save(&module, &description, Precision::Single, path, Overwrite::Yes).unwrap();
}

#[test]
fn restores_a_burst_and_resumes() {
    let folder = prepared("network-restore");
    let run = |args: &str| qudi(&folder).args(args.split_whitespace()).assert().success();
    let common = "restore b.npy --weights w.safetensors --device cpu --steps 2 --overlap 5";
    run(&format!("{common} -o whole"));
    run(&format!("{common} -o parts --shard 1/2"));
    run(&format!("{common} -o parts --shard 2/2"));
    let frames = |name: &str| {
        let mut list: Vec<_> = listing(&folder.join(name));
        list.retain(|name| name != "manifest.json");
        list.iter().map(|f| std::fs::read(folder.join(name).join(f)).unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(frames("whole").len(), 13);
    assert_eq!(frames("whole"), frames("parts"));
    // Other weights or steps are another result: the folder refuses to mix them.
    refused(&folder, &format!("{common} -o whole --steps 3").replace("--steps 2 ", ""), &["whole"]);
    // Nothing taught these weights to see what a pass before restored.
    refused(
        &folder,
        &format!("{common} -o two.npy --passes 2"),
        &["2 passes of a network that has learnt one", "where: --passes", "train.passes"],
    );
    refused(
        &folder,
        &format!("{common} -o two.npy --flow matched"),
        &["matched flow for a network of another kind", "where: --flow", "learnt"],
    );
    run("info w.safetensors");
    run(&format!("{common} -o s.npy --samples 2 --uncertainty d.npy --sampler ancestral"));
    let header = std::fs::read(folder.join("d.npy")).unwrap();
    assert!(String::from_utf8_lossy(&header[..128]).contains("(13, 32, 40)"));
}

/// The built-in weights predict their uncertainty; the frames are the same with and without it.
#[test]
fn writes_predicted_uncertainty_beside_frames() {
    let folder = prepared("network-errors");
    let run = |args: &str| qudi(&folder).args(args.split_whitespace()).assert().success();
    run("restore b.npy -o s.npy --uncertainty d.npy -q");
    run("restore b.npy -o t.npy -q");
    let [frames, alone, deviations] =
        ["s.npy", "t.npy", "d.npy"].map(|name| std::fs::read(folder.join(name)).unwrap());
    assert!(frames == alone);
    assert_eq!(deviations.len(), frames.len());
    let values = deviations[deviations.len() - 13 * 32 * 40 * 4..].chunks_exact(4);
    let values: Vec<f32> = values.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert!(values.iter().all(|&value| value > 0.0 && value < 1.0));
    let with =
        |method: &str| format!("restore b.npy -o u.npy --uncertainty e.npy --method {method}");
    refused(&folder, &with("qudi-diffusion"), &["--method qudi-regression"]);
    refused(&folder, &with("qbp-refined"), &["--method qudi"]);
}

/// Both networks have built-in weights; options of the diffusion are refused for the regression.
#[test]
fn networks_are_chosen_by_method_or_weights() {
    let folder = prepared("network-kinds");
    let restored = |options: &str| {
        let args = format!("restore b.npy --device cpu -o out.npy --force {options}");
        let output = qudi(&folder).args(args.split_whitespace()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        (std::fs::read(folder.join("out.npy")).unwrap(), said)
    };
    let (default, _) = restored("");
    assert!(default == restored("--method qudi").0);
    let (regression, said) = restored("--method qudi-regression");
    assert!(default == regression && said.contains("(regression) on cpu"), "{said}");
    let (diffusion, said) = restored("--method qudi-diffusion");
    assert!(diffusion != regression && said.contains("(diffusion in 1 step) on cpu"), "{said}");
    let (corrected, said) =
        restored("--method qudi-diffusion --correct --passes 2 --uncertainty u.npy");
    assert!(said.contains("(diffusion in 1 step and 2 passes, corrected) on cpu"), "{said}");
    assert!(corrected != diffusion && corrected != regression);
    let (again, said) = restored("--method qudi-diffusion --correct --passes 2 --json");
    assert!(again == corrected && said.contains("correction_sha256"), "{said}");
    // One step is the mean of all pictures that fit, whatever the noise; more steps draw one of them.
    let drawn = |options: &str| restored(&format!("--method qudi-diffusion {options}")).0;
    assert!(diffusion == drawn("--steps 1 --seed 7"));
    assert!(drawn("--steps 3 --seed 7") != drawn("--steps 3 --seed 8"));
    let (_, said) = restored("--weights w.safetensors");
    assert!(said.contains("(diffusion in 1 step) on cpu"), "{said}");
    let with = |options: &str| format!("restore b.npy -o refused.npy {options}");
    refused(&folder, &with("--method qudi-regression --steps 2"), &["--method qudi-diffusion"]);
    let corrected = |options: &str| with(&format!("--method qudi-diffusion --correct {options}"));
    refused(&folder, &with("--correct"), &["--method qudi-diffusion"]);
    refused(&folder, &corrected("--steps 2"), &["2 steps", "--correct"]);
    refused(&folder, &corrected("--samples 2"), &["2 samples", "--correct"]);
    refused(&folder, &corrected("--weights w.safetensors"), &["than `window`", "--correct"]);
    refused(&folder, &with("--samples 2"), &["--method qudi-diffusion"]);
    refused(&folder, &with("--seed 2"), &["--method qudi-diffusion"]);
    refused(&folder, &with("--method qudi-diffusion --steps 0"), &["--steps"]);
    let other = "--method qudi-regression --weights w.safetensors";
    refused(&folder, &with(other), &["weights of a diffusion"]);
}

#[test]
fn rejects_unfit_weights_and_options_in_three_parts() {
    let folder = prepared("network-refuse");
    let with =
        |rest: &str| format!("restore b.npy -o out --weights w.safetensors --device cpu {rest}");
    refused(&folder, "restore b.npy -o out --weights none.safetensors", &["none.safetensors"]);
    refused(&folder, &with("--steps 1001"), &["--steps"]);
    refused(&folder, &with("--samples 0"), &["--samples"]);
    refused(&folder, &with("--tile 8"), &["--tile"]);
    refused(&folder, &with("--ppp 1e5"), &["the weights were trained for"]);
    refused(&folder, &with("--uncertainty d.npy"), &["--samples"]);
    refused(
        &folder,
        &with("").replace("--device cpu", "--device nothing"),
        &["no device `nothing`"],
    );
    refused(&folder, &with("").replace("--device cpu", "--device wgpu:99"), &["wgpu:99"]);
    #[cfg(not(feature = "wgpu"))]
    refused(&folder, &with("").replace("--device cpu", "--device wgpu"), &["--features wgpu"]);
    std::fs::write(
        folder.join("torn.safetensors"),
        &std::fs::read(folder.join("w.safetensors")).unwrap()[..5000],
    )
    .unwrap();
    refused(
        &folder,
        "restore b.npy -o out --weights torn.safetensors",
        &["not a whole SafeTensors file"],
    );
    let mut broken = std::fs::read(folder.join("w.safetensors")).unwrap();
    let end = broken.len();
    broken[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(folder.join("nan.safetensors"), broken).unwrap();
    refused(
        &folder,
        "restore b.npy -o out --weights nan.safetensors --device cpu",
        &["not finite"],
    );
    qudi(&folder)
        .args("simulate scene:text --size 32x40 --frames 2 --ppp 9.75 -o two.npy -q".split(' '))
        .assert()
        .success();
    refused(
        &folder,
        "restore two.npy -o none --weights w.safetensors --device cpu",
        &["a burst of 2 frames"],
    );
    assert!(!folder.join("none").join("000000.png").exists(), "no partial output");
}

/// The default method is the bundled network if it was trained for the sensor and the light, else the best
/// method without trained weights.
#[test]
fn default_method_follows_the_capture() {
    let folder = scratch("network-usual");
    let run = |args: &str| {
        let output = qudi(&folder).args(args.split_whitespace()).output().unwrap();
        assert!(output.status.success(), "{args}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let cases = [
        ("--ppp 3.25", 4, "by qudi (regression) on cpu"),
        ("--sensor spad512s --sum 7 --ppp 3.25", 4, "by qudi"),
        ("--sensor qis16-gj --ppp 3.25", 4, "by qbp-refined"),
        ("--ppp 3.25", 2, "by qbp-refined"),
        ("--ppp 900", 4, "by qbp-refined"),
    ];
    for (number, (options, frames, expected)) in cases.into_iter().enumerate() {
        let burst = format!("b{number}.npy");
        run(&format!("simulate scene:text --size 32x40 --frames {frames} {options} -o {burst} -q"));
        let said = run(&format!("restore {burst} -o out{number} --device cpu"));
        assert!(said.contains(expected), "{options}, {frames} frames: {said}");
    }
    let said = run("info weights");
    for expected in ["qudi-regression", "small", "qudi-diffusion", "window", "qudi-paper"] {
        assert!(said.contains(expected), "{said}");
    }
}

/// Published weights are the trained ones, rounded, and their hash is right.
#[test]
fn published_weights_restore_what_trained_ones_do() {
    let folder = prepared("network-publish");
    let run = |args: &str| qudi(&folder).args(args.split_whitespace()).assert().success();
    run("publish w.safetensors -o half.safetensors");
    let said = run("info half.safetensors --json").get_output().stdout.clone();
    assert!(String::from_utf8_lossy(&said).contains("\"window\""));
    let hash = std::fs::read_to_string(folder.join("half.sha256")).unwrap();
    let said = run("info half.safetensors").get_output().stdout.clone();
    assert!(String::from_utf8_lossy(&said).contains(hash.trim()));
    for weights in ["w", "half"] {
        run(&format!(
            "restore b.npy --weights {weights}.safetensors --device cpu -o {weights}.npy"
        ));
    }
    let frames = |name: &str| -> Vec<f32> {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        let words = bytes[bytes.len() - 13 * 32 * 40 * 4..].chunks_exact(4);
        words.map(|word| f32::from_le_bytes(word.try_into().unwrap())).collect()
    };
    for (single, half) in frames("w.npy").iter().zip(frames("half.npy")) {
        assert!((single - half).abs() < 1e-3, "{single} {half}");
    }
    run("publish w.safetensors -o two.safetensors --steps 2");
    let said = run("info two.safetensors").get_output().stdout.clone();
    assert!(String::from_utf8_lossy(&said).contains("2 steps by default"));
    refused(&folder, "publish w.safetensors -o half.safetensors", &["exists"]);
    refused(&folder, "publish w.safetensors -o half.bin", &[".safetensors"]);
}

#[test]
fn processor_passes_selftest() {
    let folder = scratch("network-selftest");
    let only = "selftest --device cpu --only arithmetic,warp,regression";
    let output = qudi(&folder).args(only.split(' ')).output().unwrap();
    assert!(output.status.success());
    assert_eq!(String::from_utf8_lossy(&output.stdout).matches(" ok\n").count(), 4);
    refused(&folder, "selftest --only nothing", &["--only"]);
}

/// Runs only with a graphics card or a driver that emulates one, at sizes that such a driver takes seconds
/// for.
#[cfg(feature = "wgpu")]
#[test]
#[expect(clippy::print_stderr, reason = "says that it is skipped")]
fn graphics_card_matches_the_processor() {
    let folder = scratch("network-gpu");
    let devices = qudi(&folder).args(["info", "--devices"]).output().unwrap();
    if !String::from_utf8_lossy(&devices.stdout).contains("wgpu:0") {
        eprintln!("skipped: needs a graphics card, or a driver that imitates one");
        return;
    }
    let only = "arithmetic,joining,warp,TV-L1,softmax,group norm,matrix product,convolution 1x1,convolution 3x3";
    let device = ["selftest", "--device", "wgpu:0", "--only", only];
    let output = qudi(&folder).args(device).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
}

/// 16-bit products restore the same as 32-bit ones, on any number of threads; a missing matrix unit is an
/// error.
#[test]
fn precisions_restore_alike() {
    let folder = scratch("network-precision");
    run(&folder, "simulate scene:text --size 48x64 --frames 4 --ppp 9.75 --seed 2 -o b.npy -q");
    let restored = |options: &str, to: &str| {
        run(&folder, &format!("restore b.npy --device cpu -o {to} -q {options}"));
        std::fs::read(folder.join(to)).unwrap()
    };
    let values = |bytes: &[u8]| -> Vec<f32> {
        let data = &bytes[bytes.len() - 4 * 4 * 48 * 64..];
        data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    let exact = restored("--precision f32", "f32.npy");
    let short = restored("--precision bf16 --threads 1", "bf16.npy");
    assert!(short == restored("--precision bf16 --threads 3", "threads.npy"));
    assert!(exact != short, "the option does nothing");
    let (exact, short) = (values(&exact), values(&short));
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let error = exact.iter().zip(&short).map(square).sum::<f64>() / exact.len() as f64;
    assert!(error.sqrt() < 2e-3, "{}", error.sqrt());
    let kernels = |units: &str| {
        let mut command = qudi(&folder);
        let output = command.env("QUDI_KERNELS", units).args(["info", "weights"]).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    assert_eq!(kernels("f32").0, Some(0));
    let (code, said) = kernels("fast");
    assert!(code == Some(2) && said.contains("`fast`") && said.contains("avx512bf16"), "{said}");
}
