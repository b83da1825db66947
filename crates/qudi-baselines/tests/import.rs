//! Weight files of others: as they are found, damaged, and of every network.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/golden/cases.rs"]
mod cases;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use cases::{parameter, uniform};
use qudi_baselines::emvd::Emvd;
use qudi_baselines::flornn::{self, FloRnn};
use qudi_baselines::import::{METHODS, Method, Network, describe, load};
use qudi_baselines::memdeblur::{self, MemDeblur};
use qudi_baselines::quiver::{self, Quiver};
use qudi_baselines::restorer::LearnedRestorer;
use qudi_baselines::rvrt::{self, Rvrt};
use qudi_baselines::spk2imgnet::{self, Spk2ImgNet};
use qudi_baselines::student_teacher::{self, KernelPrediction};
use qudi_core::Size;
use qudi_core::metrics::psnr;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_layers::{init_parameters, parameter_shapes};
use safetensors::tensor::{Dtype, TensorView};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden")).join(name)
}

/// Restores two frames with EMVD.
fn image(network: &Emvd) -> Vec<f32> {
    let frame = |name: &str| {
        let values: Vec<f32> = uniform(name, 16 * 24).iter().map(|v| *v as f32).collect();
        Tensor::<4>::from_data(TensorData::new(values, [1, 1, 16, 24]), &Device::flex())
    };
    let restored = network.restore(vec![frame("a"), frame("b")]);
    restored[1].clone().into_data().try_to_vec().unwrap()
}

#[test]
fn files_are_read_as_they_are_found() {
    let device = Device::flex();
    let network = init_parameters(Emvd::zeros(4, &device), parameter);
    let expected = image(&network);
    for (name, most) in [("wrapped", 0.0), ("module", 0.0), ("turned", 0.0), ("half", 0.01)] {
        let path = golden(&format!("learned/files/{name}.pth"));
        let Network::Emvd(loaded) = load(&path, Method::Emvd, &device).unwrap().network else {
            panic!("{name}: another network");
        };
        for (value, expected) in image(&loaded).into_iter().zip(&expected) {
            assert!((value - expected).abs() <= most, "{name}: {value} for {expected}");
        }
        let contents = describe(&path, &Device::flex()).unwrap().unwrap();
        assert_eq!((contents.method, contents.sizes.as_str()), (Method::Emvd, "4 channels"));
        let shapes = parameter_shapes(&network).into_iter();
        let count: usize = shapes.map(|(_, shape)| shape.iter().product::<usize>()).sum();
        assert_eq!(contents.parameters, count);
    }
    let other = load(&golden("learned/files/wrapped.pth"), Method::Rvrt, &device).unwrap_err();
    assert!(other.to_string().contains("weights of emvd, not of rvrt"), "{other}");
}

#[test]
fn code_in_a_file_is_not_run() {
    let path = golden("perceptual/code.pth");
    assert!(describe(&path, &Device::flex()).map_or(true, |contents| contents.is_none()));
    assert!(load(&path, Method::Emvd, &Device::flex()).is_err());
}

#[test]
fn damaged_files_are_refused_without_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.pth");
    let mut refused = 0;
    for name in ["wrapped", "turned"] {
        let whole = std::fs::read(golden(&format!("learned/files/{name}.pth"))).unwrap();
        for n in 0..150 {
            let mut bytes = whole.clone();
            if n % 3 == 0 {
                bytes.truncate(whole.len() * n / 150);
            } else {
                // Most of a file is values: damage its head and its tail more often.
                let place = [n * 7, whole.len() - 1 - n * 11, whole.len() * n / 150][n % 3];
                bytes[place.min(whole.len() - 1)] ^= 1 << (n % 8);
            }
            std::fs::write(&path, &bytes).unwrap();
            refused += usize::from(load(&path, Method::Emvd, &Device::flex()).is_err());
            let _ = describe(&path, &Device::flex());
        }
    }
    assert!(refused > 100, "{refused}");
}

/// Tensors by name in a file.
fn save(path: &Path, tensors: &BTreeMap<String, Vec<usize>>) {
    let values = tensors.iter().map(|(name, shape)| {
        let mut values = parameter(name, shape);
        if name.ends_with(".running_var") {
            values = values.into_iter().map(|value| 1.0 + value.abs()).collect();
        }
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        (name.clone(), shape.clone(), bytes)
    });
    let values: Vec<_> = values.collect();
    let views = values.iter().map(|(name, shape, bytes)| {
        (name.clone(), TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap())
    });
    safetensors::serialize_to_file(views.collect::<Vec<_>>(), None, path).unwrap();
}

fn named<M: Module>(network: &M, name: fn(&str) -> String) -> BTreeMap<String, Vec<usize>> {
    parameter_shapes(network).into_iter().map(|(ours, shape)| (name(&ours), shape)).collect()
}

#[test]
fn all_keys_that_do_not_fit_are_listed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    let mut tensors = named(&Emvd::zeros(4, &Device::flex()), str::to_owned);
    tensors.remove("refine.net2.bias").unwrap();
    tensors.remove("ct.net1.weight").unwrap();
    tensors.insert("md0.fusion.net1.weight".to_owned(), vec![4, 7, 3, 3]);
    tensors.insert("net9.weight".to_owned(), vec![1]);
    tensors.insert("net9.num_batches_tracked".to_owned(), vec![1]);
    save(&path, &tensors);
    let error = load(&path, Method::Emvd, &Device::flex()).unwrap_err().to_string();
    for part in [
        "2 missing: ct.net1.weight, refine.net2.bias",
        "1 surplus: net9.weight",
        "1 of another shape: md0.fusion.net1.weight is [4, 7, 3, 3] instead of [4, 6, 3, 3]",
    ] {
        assert!(error.contains(part), "{error}");
    }
}

/// Returns the shapes of the smallest network of a method, by the names in its files.
fn smallest(method: Method) -> BTreeMap<String, Vec<usize>> {
    let device = &Device::flex();
    match method {
        Method::Quiver => {
            let sizes = quiver::Sizes { features: 16, blocks: 2, past: 2, future: 1 };
            named(&Quiver::zeros(sizes, device), Quiver::authors_name)
        }
        Method::Emvd => named(&Emvd::zeros(4, device), str::to_owned),
        Method::FloRnn => {
            let sizes = flornn::Sizes { features: 8, blocks: 1, ..flornn::PUBLISHED };
            named(&FloRnn::zeros(sizes, device), FloRnn::authors_name)
        }
        Method::Spk2ImgNet => {
            let sizes = spk2imgnet::Sizes { features: 8, stem: 4, blocks: 1, groups: 2 };
            named(&Spk2ImgNet::zeros(sizes, device), Spk2ImgNet::authors_name)
        }
        Method::MemDeblur => {
            let sizes = memdeblur::Sizes {
                features: 8,
                forward_blocks: 1,
                backward_blocks: 1,
                memory_blocks: 1,
                bottlenecks: 1,
                ..memdeblur::PUBLISHED
            };
            named(&MemDeblur::zeros(sizes, device), MemDeblur::authors_name)
        }
        Method::Rvrt => {
            let sizes = rvrt::Sizes { channels: 1, features: 12, blocks: 1 };
            named(&Rvrt::zeros(sizes, device), Rvrt::authors_name)
        }
        Method::StudentTeacher => {
            let sizes = student_teacher::Sizes { frames: 5, features: 4, kernel: 3 };
            named(&KernelPrediction::zeros(sizes, device), KernelPrediction::file_name)
        }
    }
}

/// Every method is known by its keys, and restores every frame of a burst of any size.
#[test]
fn every_method_restores_every_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    let size = Size { height: 18, width: 21 };
    let frames: Vec<Vec<u16>> = (0..13)
        .map(|t| (0..size.pixels()).map(|i| ((i * 7 + t * 3) % 8) as u16).collect())
        .collect();
    let acquisition = Acquisition::new(Sensor::load("qudi-paper").unwrap(), 3.25, 0.45).unwrap();
    for method in METHODS {
        save(&path, &smallest(method));
        assert_eq!(describe(&path, &Device::flex()).unwrap().unwrap().method, method);
        let mut restorer = LearnedRestorer::load(&path, method, &Device::flex()).unwrap();
        let mut results = Vec::new();
        for count in [1, 13] {
            let burst = BurstView { size, frames: &frames[..count] };
            let restored = restorer.restore(burst, &acquisition).unwrap().frames;
            assert_eq!(restored.len(), count, "{}", method.name());
            for frame in &restored {
                assert_eq!(frame.size, size);
                assert!(frame.data.iter().all(|v| (0.0..=1.0).contains(v)), "{}", method.name());
            }
            results.push(restored);
        }
        // Other counts, another picture.
        let differs = results[1].windows(2).any(|pair| pair[0].data != pair[1].data);
        assert!(differs, "{}", method.name());
    }
}

/// Some frames of a window are restored from the real frames around them, as with all others; but recurrences
/// begin elsewhere.
#[test]
fn wanted_frames_equal_those_of_the_whole_window() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    let size = Size { height: 16, width: 20 };
    let frames: Vec<Vec<u16>> = (0..21)
        .map(|t| (0..size.pixels()).map(|i| ((i * 5 + i / 7 + t * t) % 8) as u16).collect())
        .collect();
    let acquisition = Acquisition::new(Sensor::load("qudi-paper").unwrap(), 3.25, 0.45).unwrap();
    for method in METHODS {
        save(&path, &smallest(method));
        let mut restorer = LearnedRestorer::load(&path, method, &Device::flex()).unwrap();
        let [before, after] = restorer.context();
        assert!(restorer.window() > before + after, "{}", method.name());
        let burst = BurstView { size, frames: &frames };
        let all = restorer.restore(burst, &acquisition).unwrap().frames;
        let wanted = [9, 12, 10];
        let some = restorer.restore_frames(burst, &acquisition, &wanted).unwrap().frames;
        assert_eq!(some.len(), 3, "{}", method.name());
        let worst = wanted.iter().zip(&some).flat_map(|(&number, frame)| {
            frame.data.iter().zip(&all[number].data).map(|(a, b)| (a - b).abs())
        });
        let worst = worst.fold(0.0, f32::max);
        let recurrent = [Method::Quiver, Method::Emvd].contains(&method);
        assert!(recurrent || worst < 1e-6, "{}: {worst}", method.name());
        let nothing = restorer.restore_frames(burst, &acquisition, &[]).unwrap();
        assert!(nothing.frames.is_empty());
    }
}

/// Tiles that overlap join to nearly what the whole frame gives.
#[test]
fn tiles_restore_nearly_what_whole_frames_do() {
    let size = Size { height: 40, width: 200 };
    let frames: Vec<Vec<u16>> = (0..3)
        .map(|t| (0..size.pixels()).map(|i| ((i * 5 + i / 7 + t * t) % 8) as u16).collect())
        .collect();
    let burst = BurstView { size, frames: &frames };
    let acquisition = Acquisition::new(Sensor::load("qudi-paper").unwrap(), 3.25, 0.45).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    save(&path, &smallest(Method::Emvd));
    let restore = |tile| {
        let loaded = LearnedRestorer::load(&path, Method::Emvd, &Device::flex()).unwrap();
        let mut restorer = loaded.with_tile(tile).unwrap();
        restorer.restore(burst, &acquisition).unwrap().frames.remove(2)
    };
    let (whole, tiled) = (restore(512), restore(128));
    let agreement = psnr(&whole, &tiled);
    assert!(agreement > 40.0, "{agreement} dB");
    assert_ne!(whole, tiled);
    let smaller = LearnedRestorer::load(&path, Method::Emvd, &Device::flex()).unwrap();
    let refused = smaller.with_tile(63).unwrap_err();
    assert_eq!(refused.help().as_deref(), Some("emvd needs at least 64"));
}
