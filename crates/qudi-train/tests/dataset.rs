//! Training data: packs hold what files hold, samples depend on seed and number alone, damage is refused.
#![allow(clippy::unwrap_used)]

use image::{GrayImage, Luma};
use qudi_core::Error;
use qudi_core::atomic_file::Overwrite;
use qudi_train::dataset::{
    DataConfig, Dataset, LightRange, Pack, Sample, SensorMix, SourceConfig, SourceKind, write_pack,
};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn source(name: &str, kind: SourceKind, from: &[&str]) -> SourceConfig {
    let from = from.iter().map(|&f| f.to_owned()).collect();
    SourceConfig {
        name: name.into(),
        kind,
        from,
        weight: 1.0,
        stride: 2,
        max_downscale: 1.0,
        speed: 2.0,
        static_fraction: 0.0,
    }
}

fn config(source: Vec<SourceConfig>) -> DataConfig {
    let ppp = LightRange::Between { from: 1.0, to: 30.0 };
    let mix = SensorMix { name: "qudi-paper".into(), ppp, frames_summed: None, weight: 1.0 };
    DataConfig { frames: 3, crop: 16, sensor: vec![mix], source }.checked().unwrap()
}

/// Returns a value that tells clip, frame and pixel; at most 140.
fn value(clip: u32, frame: u32, x: u32, y: u32) -> u8 {
    (20 + 7 * clip + 5 * frame + x + 2 * y) as u8
}

/// Computes the mean of a clip, as a share of full scale.
fn clip_mean(clip: u32) -> f64 {
    let row = |t, y| (0..24).map(move |x| f64::from(value(clip, t, x, y)));
    let values = (0..8).flat_map(|t| (0..20).flat_map(move |y| row(t, y)));
    values.sum::<f64>() / (8.0 * 20.0 * 24.0) / 255.0
}

/// Two clips of eight frames and a still in a folder.
fn files(folder: &Path) {
    for clip in 0..2 {
        let path = folder.join(format!("clips/c{clip}"));
        std::fs::create_dir_all(&path).unwrap();
        for frame in 0..8 {
            let image = GrayImage::from_fn(24, 20, |x, y| Luma([value(clip, frame, x, y)]));
            image.save(path.join(format!("{frame}.png"))).unwrap();
        }
    }
    std::fs::create_dir_all(folder.join("stills")).unwrap();
    let image = GrayImage::from_fn(40, 30, |x, y| Luma([(3 * x + 4 * y) as u8]));
    image.save(folder.join("stills/a.png")).unwrap();
}

fn all_sources() -> DataConfig {
    config(vec![
        source("clips", SourceKind::Clips, &["clips"]),
        source("stills", SourceKind::Stills, &["stills"]),
        source("scenes", SourceKind::Scenes, &["dead-leaves", "text"]),
    ])
}

/// Packs the files for `config`.
fn pack(config: &DataConfig, folder: &Path) -> Result<PathBuf, Error> {
    let path = folder.join("pack.zip");
    write_pack(&[config], folder, &path, Overwrite::Yes, &mut |_| ControlFlow::Continue(()))?;
    Ok(path)
}

fn same(a: &Sample, b: &Sample) -> bool {
    a.truth == b.truth && a.counts == b.counts && a.acquisition.ppp == b.acquisition.ppp
}

#[test]
fn pack_holds_the_pixels_of_the_files() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let path = pack(&all_sources(), folder.path()).unwrap();
    let mut pack = Pack::open(&path).unwrap();
    let names: Vec<_> = pack
        .clips()
        .iter()
        .map(|clip| (clip.source.clone(), clip.name.clone(), clip.frames))
        .collect();
    let expected = [("clips", "clips-c0", 8), ("clips", "clips-c1", 8), ("stills", "stills-a", 1)];
    assert_eq!(names, expected.map(|(s, n, f)| (s.to_owned(), n.to_owned(), f)));
    for clip in 0..2 {
        let mut sum = 0.0;
        for frame in 0..8 {
            let image = pack.frame(clip, frame).unwrap();
            for (i, &seen) in image.data.iter().enumerate() {
                let (x, y) = (i as u32 % 24, i as u32 / 24);
                assert_eq!(seen, f32::from(value(clip as u32, frame as u32, x, y)) / 255.0);
            }
            sum += image.mean();
        }
        assert!((pack.clips()[clip].mean - sum / 8.0).abs() < 1e-9);
    }
}

#[test]
fn samples_depend_on_seed_and_number_only() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = all_sources();
    let path = pack(&config, folder.path()).unwrap();
    let mut one = Dataset::new(&config, Some(Pack::open(&path).unwrap())).unwrap();
    let mut other = one.try_clone().unwrap();
    let forth: Vec<_> = (0..12).map(|k| one.sample(5, k).unwrap()).collect();
    let mut back: Vec<_> = (0..12).rev().map(|k| other.sample(5, k).unwrap()).collect();
    back.reverse();
    assert!(forth.iter().zip(&back).all(|(a, b)| same(a, b)));
    assert!(!same(&forth[0], &one.sample(6, 0).unwrap()));
    for (i, a) in forth.iter().enumerate() {
        assert!(forth[..i].iter().all(|b| !same(a, b)), "sample {i} repeats another");
    }
}

/// A clip's pixels relative to its exposure are the same as in the file: rescaling changes both alike.
#[test]
fn mean_level_is_that_of_the_whole_clip() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = config(vec![source("clips", SourceKind::Clips, &["clips/c1"])]);
    let path = pack(&config, folder.path()).unwrap();
    let mut dataset = Dataset::new(&config, Some(Pack::open(&path).unwrap())).unwrap();
    let mean = 255.0 * clip_mean(1);
    let mut factors = Vec::new();
    for k in 0..50 {
        let sample = dataset.sample(1, k).unwrap();
        assert_eq!(sample.truth.len(), 3);
        for frame in &sample.truth {
            for &v in &frame.data {
                assert!((0.0..=1.0).contains(&v));
                // Every pixel is a whole number of the file's steps.
                let level = f64::from(v) / sample.acquisition.mean_level * mean;
                assert!((level - level.round()).abs() < 1e-3 && level >= 20.0, "{level}");
            }
        }
        factors.push(sample.acquisition.mean_level * 255.0 / mean);
    }
    let most = factors.iter().fold(0.0f64, |a, &b| a.max(b));
    let least = factors.iter().fold(9.0f64, |a, &b| a.min(b));
    assert!((0.6..0.7).contains(&least) && (1.3..=1.5).contains(&most), "{least} {most}");
}

/// Clips become smaller by factors between one and what the recipe says: their slopes steeper.
#[test]
fn clips_are_downscaled_up_to_max_downscale() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut config = config(vec![source("clips", SourceKind::Clips, &["clips/c1"])]);
    config.source[0].max_downscale = 1.25;
    let path = pack(&config, folder.path()).unwrap();
    let mut dataset = Dataset::new(&config, Some(Pack::open(&path).unwrap())).unwrap();
    let mut factors = Vec::new();
    for k in 0..100 {
        let sample = dataset.sample(3, k).unwrap();
        let frame = &sample.truth[0];
        assert_eq!(frame.size.pixels(), 256);
        // From one corner to the other the file's values rise by 1 + 2 for every step of both, or one against
        // the other.
        let at = |x: usize, y: usize| f64::from(frame.data[16 * y + x]);
        let (across, down) = (at(15, 0) - at(0, 0), at(0, 15) - at(0, 0));
        let level = 255.0 * (across.abs() + down.abs()) / 15.0;
        let brightness = sample.acquisition.mean_level / clip_mean(1);
        factors.push(level / 3.0 / brightness);
    }
    let most = factors.iter().fold(0.0f64, |a, &b| a.max(b));
    let least = factors.iter().fold(9.0f64, |a, &b| a.min(b));
    assert!((0.99..1.01).contains(&least) && (1.23..1.26).contains(&most), "{least} {most}");
    config.source[0].max_downscale = 0.5;
    assert!(config.checked().unwrap_err().to_string().contains("max_downscale"));
}

/// As many stills rest as the recipe says, all frames alike; the others move.
#[test]
fn static_fraction_of_the_stills_does_not_move() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut config = config(vec![source("stills", SourceKind::Stills, &["stills"])]);
    config.source[0].static_fraction = 0.3;
    let path = pack(&config, folder.path()).unwrap();
    let mut dataset = Dataset::new(&config, Some(Pack::open(&path).unwrap())).unwrap();
    let mut resting = 0;
    for k in 0..200 {
        let truth = dataset.sample(4, k).unwrap().truth;
        resting += usize::from(truth.iter().all(|frame| frame.data == truth[0].data));
    }
    assert!((45..75).contains(&resting), "{resting} of 200");
    config.source[0].static_fraction = 1.1;
    assert!(config.checked().unwrap_err().to_string().contains("static_fraction"));
}

/// Light is log-uniform, and the photons are those that it gives.
#[test]
fn light_is_log_uniform_and_counts_follow_it() {
    let config = config(vec![source("scenes", SourceKind::Scenes, &["dead-leaves"])]);
    let mut dataset = Dataset::new(&config, None).unwrap();
    let (mut logs, mut seen, mut expected) = (Vec::new(), 0.0, 0.0);
    for k in 0..400 {
        let sample = dataset.sample(9, k).unwrap();
        logs.push((sample.acquisition.ppp / 1.0).ln() / 30f64.ln());
        let sensor = &sample.acquisition.sensor;
        let photons = sample.acquisition.photons_per_unit();
        for (counts, truth) in sample.counts.iter().zip(&sample.truth) {
            // Mean response without noise; saturation bends it, so only dim pixels are summed.
            for (&count, &value) in counts.iter().zip(&truth.data) {
                let electrons = sensor.quantum_efficiency * photons * f64::from(value)
                    + sensor.dark_per_frame().unwrap();
                if electrons * sample.acquisition.gain < 2.0 {
                    seen += f64::from(count);
                    expected += electrons * sample.acquisition.gain;
                }
            }
        }
    }
    let mean = logs.iter().sum::<f64>() / 400.0;
    assert!(logs.iter().all(|v| (0.0..=1.0).contains(v)) && (mean - 0.5).abs() < 0.06, "{mean}");
    assert!((seen / expected - 1.0).abs() < 0.02, "{seen} {expected}");
}

#[test]
fn rejects_data_that_cannot_be_sampled() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = all_sources();
    let path = pack(&config, folder.path()).unwrap();
    let open = || Some(Pack::open(&path).unwrap());
    let mut large = config.clone();
    large.crop = 32;
    let error = Dataset::new(&large, open()).unwrap_err();
    assert!(error.to_string().contains("clips-c0"), "{error}");
    let mut long = config.clone();
    long.frames = 9;
    assert!(Dataset::new(&long, open()).is_err());
    let mut other = config.clone();
    other.source[0].name = "others".into();
    let error = Dataset::new(&other, open()).unwrap_err();
    assert!(error.to_string().contains("others"), "{error}");
    assert!(Dataset::new(&config, None).unwrap_err().place().is_some_and(|p| p == "data.source"));
    for (key, broken) in [
        ("frames", DataConfig { frames: 2, ..config.clone() }),
        ("crop", DataConfig { crop: 0, ..config.clone() }),
        ("sensor", DataConfig { sensor: vec![], ..config.clone() }),
        ("source", DataConfig { source: vec![], ..config.clone() }),
    ] {
        let error = broken.checked().unwrap_err();
        assert!(error.to_string().contains(key), "{error}");
    }
    let missing = super_config("no-such-folder");
    assert!(matches!(pack_in(&missing, folder.path()), Err(Error::Io { .. })));
}

fn super_config(from: &str) -> DataConfig {
    config(vec![source("clips", SourceKind::Clips, &[from])])
}

fn pack_in(config: &DataConfig, folder: &Path) -> Result<PathBuf, Error> {
    let path = folder.join("other.zip");
    let result =
        write_pack(&[config], folder, &path, Overwrite::No, &mut |_| ControlFlow::Continue(()));
    assert!(result.is_ok() || !path.exists(), "a failed pack left a file");
    result.map(|()| path)
}

/// Damage anywhere gives an error or other pixels, never a panic.
#[test]
fn rejects_damaged_packs() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = super_config("clips/c0");
    let path = pack(&config, folder.path()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let look = |bytes: &[u8]| {
        let broken = folder.path().join("broken.zip");
        std::fs::write(&broken, bytes).unwrap();
        let mut dataset = Dataset::new(&config, Some(Pack::open(&broken)?))?;
        (0..3).try_for_each(|k| dataset.sample(1, k).map(|_| ()))
    };
    look(&whole).unwrap();
    for length in (0..whole.len()).step_by(whole.len() / 40) {
        assert!(look(&whole[..length]).is_err(), "{length} bytes of {}", whole.len());
    }
    for i in 0..300 {
        let mut bytes = whole.clone();
        let at = (i * 7919) % bytes.len();
        bytes[at] ^= 1 << (i % 8);
        let _ = look(&bytes);
    }
    assert!(look(b"no archive at all").is_err());
}
