//! Weight files: what was saved comes back; damaged and hostile files are refused with reasons.
#![allow(clippy::unwrap_used)]

use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor};
use qudi_core::atomic_file::Overwrite;
use qudi_layers::Provenance;
use qudi_model::checkpoint::{Description, Precision, Sampling, describe, load, load_bytes, save};
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::{Diffusion, DiffusionConfig};
use qudi_model::regression::Regression;
use qudi_model::{init_parameters, parameter_shapes};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

fn config() -> DiffusionConfig {
    let text = include_str!("../../../tests/golden/tiny.toml");
    let NetworkConfig::Diffusion(config) = NetworkConfig::parse(text, "tiny").unwrap() else {
        panic!("tiny is a diffusion")
    };
    config
}

fn description() -> Description {
    Description {
        preset: Some("tiny".into()),
        network: NetworkConfig::Diffusion(config()),
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
    }
}

fn network(seed: u64) -> Diffusion {
    config().init(seed, &Device::flex())
}

/// Values of all parameters by name.
fn values(network: Diffusion) -> Vec<(String, Vec<f32>)> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    save(&network, &description(), Precision::Single, &path, Overwrite::No).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let mut list: Vec<_> = tensors
        .tensors()
        .into_iter()
        .map(|(name, tensor)| {
            let words = tensor.data().chunks_exact(4);
            (name, words.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect())
        })
        .collect();
    list.sort_by(|a, b| a.0.cmp(&b.0));
    list
}

/// Saves a network in a folder of its own.
fn saved() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    save(&network(5), &description(), Precision::Single, &path, Overwrite::No).unwrap();
    (folder, path)
}

fn refused(path: &Path) -> String {
    let error = load::<Diffusion>(path, &Device::flex()).unwrap_err();
    assert!(error.help().is_some() && error.place().is_some(), "{error}");
    error.to_string()
}

#[test]
fn saved_weights_load_unchanged() {
    let (_folder, path) = saved();
    let (back, description_back) = load(&path, &Device::flex()).unwrap();
    assert_eq!(description_back, description());
    assert_eq!(values(back), values(network(5)));
    assert_ne!(values(network(6)), values(network(5)));
    let taken =
        save(&network(6), &description(), Precision::Single, &path, Overwrite::No).unwrap_err();
    assert!(taken.to_string().contains("exists"), "{taken}");
}

/// Sixteen bits keep eleven of the leading ones, in half the space.
#[test]
fn half_precision_file_is_small_and_accurate() {
    let (folder, path) = saved();
    let half = folder.path().join("half.safetensors");
    save(&network(5), &description(), Precision::Half, &half, Overwrite::No).unwrap();
    let length = |path: &Path| std::fs::metadata(path).unwrap().len();
    assert!(length(&half) * 10 < length(&path) * 6);
    let bytes = std::fs::read(&half).unwrap();
    let (back, _) = load_bytes(&bytes, &half, &Device::flex()).unwrap();
    for ((name, half), (_, single)) in values(back).into_iter().zip(values(network(5))) {
        for (half, single) in half.iter().zip(single) {
            assert!((half - single).abs() <= single.abs() / 2048.0 + 3e-8, "{name}");
        }
    }
}

#[test]
fn initial_weights_are_equal_on_all_backends() {
    #[allow(deprecated)] // asked for by name
    let ndarray = config().init(5, &Device::ndarray());
    assert_eq!(values(ndarray), values(network(5)));
}

#[test]
fn loads_half_precision() {
    let (folder, path) = saved();
    let bytes = std::fs::read(&path).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    // Halves of 1.5 everywhere.
    let views: Vec<_> = tensors
        .tensors()
        .into_iter()
        .map(|(name, tensor)| {
            (name, tensor.shape().to_vec(), [0x00, 0x3E].repeat(tensor.data().len() / 4))
        })
        .collect();
    let views = views.iter().map(|(name, shape, data)| {
        let dtype = safetensors::Dtype::F16;
        (name, safetensors::tensor::TensorView::new(dtype, shape.clone(), data).unwrap())
    });
    let half = safetensors::serialize(views, header.metadata().clone()).unwrap();
    let path = folder.path().join("half.safetensors");
    std::fs::write(&path, half).unwrap();
    let (network, _) = load(&path, &Device::flex()).unwrap();
    assert!(values(network).iter().all(|(_, values)| values.iter().all(|&v| v == 1.5)));
}

#[test]
fn rejects_damaged_and_mismatched_files() {
    let (folder, path) = saved();
    let whole = std::fs::read(&path).unwrap();
    let write = |bytes: &[u8]| {
        let path = folder.path().join("broken.safetensors");
        std::fs::write(&path, bytes).unwrap();
        path
    };
    for length in [0, 7, 8, 100, whole.len() / 2, whole.len() - 1] {
        refused(&write(&whole[..length]));
    }
    // A header that claims to be huge.
    let mut huge = whole.clone();
    huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    refused(&write(&huge));
    let text = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = whole.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut bytes = whole.clone();
        bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
        write(&bytes)
    };
    assert!(refused(&text("\"qudi\":", "\"qUdi\":")).contains("another program"));
    // Sizes that the file does not hold: refused before anything is allocated.
    let sizes = refused(&text("\\\"width\\\":12", "\\\"width\\\":99"));
    assert!(sizes.contains("unet"), "{sizes}");
    assert!(refused(&text("unet.out.weight", "unet.out.wEight")).contains("missing"));
    assert!(refused(&text("\\\"window\\\":11", "\\\"window\\\":01")).contains("cannot be read"));
}

#[test]
fn rejects_weights_that_are_not_finite() {
    let broken = init_parameters(network(5), |name, shape| {
        let value = if name == "unet.norm.bias" { f32::NAN } else { 0.1 };
        vec![value; shape.iter().product()]
    });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("nan.safetensors");
    let error = save(&broken, &description(), Precision::Single, &path, Overwrite::No);
    let message = error.unwrap_err().to_string();
    assert!(message.contains("unet.norm.bias") && !path.exists(), "{message}");
    let (_folder, path) = saved();
    let mut bytes = std::fs::read(&path).unwrap();
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    assert!(refused(&path).contains("not finite"));
}

#[test]
fn randomly_damaged_files_never_panic() {
    let (folder, path) = saved();
    let whole = std::fs::read(&path).unwrap();
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let mut state = 12345u64;
    let path = folder.path().join("damaged.safetensors");
    for _ in 0..300 {
        let mut bytes = whole.clone();
        for _ in 0..3 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let place = (state >> 33) as usize % header;
            bytes[place] = (state >> 20) as u8;
        }
        std::fs::write(&path, bytes).unwrap();
        // Some damage changes nothing that counts.
        if load::<Diffusion>(&path, &Device::flex()).is_ok() {
            describe(&path).unwrap();
        }
    }
}

#[test]
fn parameter_names_are_unique() {
    let list = parameter_shapes(&network(1));
    let mut names: Vec<_> = list.iter().map(|(name, _)| name).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), list.len());
    let count: usize = list.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
    assert_eq!(count, 179_560); // tests/golden/generate/network.py, with the sizes of tests/golden/tiny.toml
}

#[test]
fn kinds_are_not_mistaken_for_each_other() {
    let (_folder, path) = saved();
    let error = load::<Regression>(&path, &Device::flex()).unwrap_err();
    assert!(error.to_string().contains("weights of a diffusion"), "{error}");
    assert!(error.help().unwrap().contains("--method qudi-diffusion"), "{error}");
}

/// Writes a file of the former format, in which one network could be both, with parameters by their former
/// names.
fn former(network: &str, parameters: &[(String, Vec<usize>)]) -> Vec<u8> {
    let description = format!(
        r#"{{"preset":null,"network":{network},"window":11,"program":"qudi 0.1.0","sensors":[],"ppp":[1.0,2.0],
        "data":[],"steps":0,"commit":null,"licence":"MIT","default_steps":0,"kind":"regression"}}"#
    );
    let bytes: Vec<Vec<u8>> = parameters
        .iter()
        .map(|(name, shape)| {
            let value = if name.starts_with("stages.") { 0.25f32 } else { 0.5 };
            value.to_le_bytes().repeat(shape.iter().product())
        })
        .collect();
    let views = parameters.iter().zip(&bytes).map(|((name, shape), bytes)| {
        let dtype = safetensors::Dtype::F32;
        (name, safetensors::tensor::TensorView::new(dtype, shape.clone(), bytes).unwrap())
    });
    let metadata = HashMap::from([("qudi".to_owned(), description)]);
    safetensors::serialize(views, Some(metadata)).unwrap()
}

/// A regression of version 0.1.0, with the parts that were on top of it.
#[test]
fn reads_former_regressions_and_refuses_their_diffusion() {
    let text = include_str!("../../../tests/golden/regression.toml");
    let NetworkConfig::Regression(config) = NetworkConfig::parse(text, "regression").unwrap()
    else {
        panic!("not a regression")
    };
    let device = Device::flex();
    let mut list: Vec<_> = parameter_shapes(&config.uninitialized(&device))
        .into_iter()
        .map(|(name, shape)| (name.replace("refinement.", "stages.0."), shape))
        .collect();
    list.push(("pre.simulated_in.weight".to_owned(), vec![8, 9, 3, 3]));
    list.push(("unet.out.bias".to_owned(), vec![4]));
    let sizes = |uncertainty: bool| {
        format!(
            r#"{{"fold":2,"pre":{{"width":8,"blocks":2,"growth":4,"neighbours":4,"alignments":3,
            "weight_channels":4,"stages":2,"uncertainty":{uncertainty}}},"unet":{{}}}}"#
        )
    };
    let bytes = former(&sizes(true), &list);
    let place = Path::new("former");
    let (network, description) = load_bytes::<Regression>(&bytes, place, &device).unwrap();
    assert_eq!(description.network, NetworkConfig::Regression(config));
    let mut first = Vec::new();
    network.refinement().unwrap().visit(&mut FirstValues(&mut first));
    assert!(first.iter().all(|&value| value == 0.25));
    network.visit(&mut FirstValues(&mut first));
    assert!(first.contains(&0.5));
    let error = load_bytes::<Diffusion>(&bytes, place, &device).unwrap_err().to_string();
    assert!(error.contains("lesions showed"), "{error}");
    let bytes = former(&sizes(false), &list);
    let error = load_bytes::<Regression>(&bytes, place, &device).unwrap_err().to_string();
    assert!(error.contains("was removed"), "{error}");
}

/// The first value of every parameter.
struct FirstValues<'a>(&'a mut Vec<f32>);

impl ModuleVisitor for FirstValues<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.0.push(qudi_layers::tensor::read(param.val()).unwrap()[0]);
    }
}
