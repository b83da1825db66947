//! Training data: packs hold what files hold, samples depend on seed and number alone, damage is refused.
#![allow(clippy::unwrap_used)]

use image::{GrayImage, Luma};
use qudi_core::Error;
use qudi_core::atomic_file::Overwrite;
use qudi_train::dataset::{
    ClipWindow, DataConfig, Dataset, LightRange, Pack, PackProgress, PackedSource, Sample,
    SensorMix, SourceConfig, SourceKind, write_pack,
};
use std::io::Write;
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
        shrink: 1.0,
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

/// Packs files.
fn pack(sources: &[PackedSource], folder: &Path) -> Result<PathBuf, Error> {
    let path = folder.join("pack.zip");
    write_pack(sources, folder, &path, Overwrite::Yes, None, &mut |_| ControlFlow::Continue(()))?;
    Ok(path)
}

/// Draws from the packed files of `config`.
fn dataset(config: &DataConfig, folder: &Path) -> Dataset {
    let sources = config.packed_sources();
    let path = pack(&sources, folder).unwrap();
    Dataset::new(config, Some(Pack::open(&path, &sources).unwrap())).unwrap()
}

/// Draws from files that are packed as validation clips are, without loss.
fn exact_dataset(config: &DataConfig, folder: &Path) -> Dataset {
    let mut sources = config.packed_sources();
    for source in &mut sources {
        source.lossless = Some(ClipWindow { frames: 100, crop: 100 });
    }
    let path = pack(&sources, folder).unwrap();
    Dataset::new(config, Some(Pack::open(&path, &sources).unwrap())).unwrap()
}

fn same(a: &Sample, b: &Sample) -> bool {
    a.truth == b.truth && a.counts == b.counts && a.acquisition.ppp == b.acquisition.ppp
}

#[test]
fn packs_hold_what_files_hold() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut sources = all_sources().packed_sources();
    sources.push(PackedSource {
        name: "validation".into(),
        lossless: Some(ClipWindow { frames: 4, crop: 16 }),
        ..sources[0].clone()
    });
    let path = folder.path().join("pack.zip");
    let go_on = &mut |_: &_| ControlFlow::Continue(());
    let psnr =
        write_pack(&sources, folder.path(), &path, Overwrite::No, None, go_on).unwrap().unwrap();
    assert!((40.0..60.0).contains(&psnr), "{psnr} dB");
    let pack = Pack::open(&path, &sources).unwrap();
    let clips = pack.clips().iter();
    let names: Vec<_> =
        clips.map(|clip| (clip.source.as_str(), clip.name.as_str(), clip.frames)).collect();
    let expected = [
        ("clips", "clips-c0", 8),
        ("clips", "clips-c1", 8),
        ("stills", "stills-a", 1),
        ("validation", "clips-c0", 4),
        ("validation", "clips-c1", 4),
    ];
    assert_eq!(names, expected);
    let file = |x: usize, y: usize, clip: usize, frame: usize| {
        value(clip as u32, frame as u32, x as u32, y as u32)
    };
    for clip in 0..2 {
        for frame in 0..8 {
            let image = pack.frame(clip, frame);
            for (i, &seen) in image.values.iter().enumerate() {
                let source = file(i % 24, i / 24, clip, frame);
                assert!(seen.abs_diff(source) <= 4, "{seen} for {source}");
            }
        }
        assert!((pack.mean(clip) - clip_mean(clip as u32)).abs() < 2e-3);
        // Four of eight frames, 16 x 16 of 20 x 24 pixels.
        for frame in 0..4 {
            let image = pack.frame(3 + clip, frame);
            assert_eq!((image.size.height, image.size.width), (16, 16));
            for (i, &seen) in image.values.iter().enumerate() {
                assert_eq!(seen, file(4 + i % 16, 2 + i / 16, clip, 2 + frame));
            }
        }
    }
}

#[test]
fn packs_are_smaller_by_shrink() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut config = config(vec![source("clips", SourceKind::Clips, &["clips/c1"])]);
    config.source[0].shrink = 1.25;
    let sources = config.packed_sources();
    let path = pack(&sources, folder.path()).unwrap();
    let pack = Pack::open(&path, &sources).unwrap();
    let frame = pack.frame(0, 2);
    assert_eq!((frame.size.height, frame.size.width), (16, 19));
    let mut sum = 0.0;
    for (i, &seen) in frame.values.iter().enumerate() {
        let place = |i: usize, short: f64, long: f64| (i as f64 + 0.5) * long / short - 0.5;
        let level = 37.0 + place(i % 19, 19.0, 24.0) + 2.0 * place(i / 19, 16.0, 20.0);
        sum += (f64::from(seen) - level).powi(2);
    }
    let error = (sum / frame.values.len() as f64).sqrt();
    assert!(error < 3.0, "{error} levels");
}

/// Changes a recipe's sources.
type Change<'a> = &'a dyn Fn(&mut Vec<PackedSource>);

/// A pack says what it was made from: another recipe is refused, part of it is not.
#[test]
fn rejects_packs_of_other_recipes() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut sources = all_sources().packed_sources();
    sources.push(PackedSource {
        name: "validation".into(),
        lossless: Some(ClipWindow { frames: 6, crop: 20 }),
        ..sources[0].clone()
    });
    let path = pack(&sources, folder.path()).unwrap();
    let open = |change: &dyn Fn(&mut Vec<PackedSource>)| {
        let mut other = sources.clone();
        change(&mut other);
        Pack::open(&path, &other).map(drop)
    };
    open(&|_| ()).unwrap();
    open(&|sources| drop(sources.remove(0))).unwrap();
    open(&|sources| sources[2].lossless = Some(ClipWindow { frames: 5, crop: 16 })).unwrap();
    let changes: [(&str, Change); 6] = [
        ("shrink\":1.5", &|sources| sources[0].shrink = 1.5),
        ("clips/c0", &|sources| sources[0].from = vec!["clips/c0".into()]),
        ("stills", &|sources| sources[0].kind = SourceKind::Stills),
        ("no source `films`; it has clips", &|sources| sources[0].name = "films".into()),
        ("lossless", &|sources| sources[0].lossless = sources[2].lossless),
        ("21", &|sources| sources[2].lossless = Some(ClipWindow { frames: 6, crop: 21 })),
    ];
    for (text, change) in changes {
        let error = open(change).unwrap_err();
        assert!(error.to_string().contains(text), "{error}");
        assert!(error.help().unwrap().contains("--prepare"), "{:?}", error.help());
    }
}

#[test]
fn samples_depend_on_seed_and_number_only() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = all_sources();
    let one = dataset(&config, folder.path());
    let other = one.clone();
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
    let dataset = exact_dataset(&config, folder.path());
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
    let dataset = exact_dataset(&config, folder.path());
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
    let dataset = dataset(&config, folder.path());
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
    let dataset = Dataset::new(&config, None).unwrap();
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

/// Draws from dead leaves with a file of a sensor.
fn dataset_of(folder: &Path, sensor: &str) -> Result<Dataset, Error> {
    let path = folder.join("lab.toml");
    std::fs::write(&path, format!("base = \"qudi-paper\"\n{sensor}")).unwrap();
    let mut config = config(vec![source("scenes", SourceKind::Scenes, &["dead-leaves"])]);
    path.to_str().unwrap().clone_into(&mut config.sensor[0].name);
    Dataset::new(&config, None)
}

/// Cross-talk is counted as light, as `restore` does, and a pattern of hot pixels is never the same.
#[test]
fn samples_know_of_defects_what_restore_does() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = dataset_of(folder.path(), "[defects]\ncrosstalk = 0.03").unwrap();
    let plain = dataset_of(folder.path(), "").unwrap();
    let (sample, plain) = (dataset.sample(9, 1).unwrap(), plain.sample(9, 1).unwrap());
    let [seen, without] = [&sample, &plain].map(|sample| &sample.acquisition.sensor);
    assert_eq!(seen.defects.crosstalk, 0.0);
    let factor = seen.quantum_efficiency / without.quantum_efficiency;
    assert!((factor - 1.12).abs() < 1e-9, "{factor}");
    let defects = "[defects]\nhot_fraction = 0.1\nhot_dark = 1000.0";
    let dataset = dataset_of(folder.path(), defects).unwrap();
    let hot = |number| {
        let sample = dataset.sample(9, number).unwrap();
        let is_hot = |at: &usize| sample.counts.iter().all(|frame| frame[*at] == 7);
        (0..sample.counts[0].len()).filter(is_hot).collect::<Vec<_>>()
    };
    assert!(hot(0).len() > 5 && hot(1).len() > 5 && hot(0) != hot(1));
    let map = folder.path().join("map.npy");
    let error = dataset_of(folder.path(), &format!("[defects]\ndark_map = {map:?}")).unwrap_err();
    assert!(error.to_string().contains("map.npy"), "{error}");
    assert!(error.place().is_some_and(|place| place == "data.sensor"));
}

#[test]
fn rejects_data_that_cannot_be_sampled() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let config = all_sources();
    let sources = config.packed_sources();
    let path = pack(&sources, folder.path()).unwrap();
    let open = || Some(Pack::open(&path, &sources).unwrap());
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

/// One bad clip says what to do, and the next one is not found only after it was mended.
#[test]
fn names_all_unreadable_clips_at_once() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    for name in ["c0/3.png", "c1/0.png"] {
        std::fs::write(folder.path().join("clips").join(name), b"no image").unwrap();
    }
    let error = pack_in(&super_config("clips"), folder.path()).unwrap_err();
    let words = format!("{error}; {}", error.help().unwrap_or_default());
    for part in ["2 of 2 clips", "clips/c0", "clips/c1", "not a readable image", "move them out"] {
        assert!(words.contains(part), "{part}: {words}");
    }
}

/// Clips that cannot be read are left out on request, and a source without any other is refused all the same.
#[test]
fn leaves_unreadable_clips_out_on_request() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let clips = folder.path().join("clips");
    std::fs::write(clips.join("c0/3.png"), b"no image").unwrap();
    let sources = super_config("clips").packed_sources();
    let path = folder.path().join("other.zip");
    let pack = |skipped: &mut Vec<String>| {
        let go_on = &mut |_: &PackProgress| ControlFlow::Continue(());
        write_pack(&sources, folder.path(), &path, Overwrite::Yes, Some(skipped), go_on)
    };
    let mut skipped = Vec::new();
    pack(&mut skipped).unwrap();
    assert!(skipped.len() == 1 && skipped[0].contains("c0"), "{skipped:?}");
    let names: Vec<_> =
        Pack::open(&path, &sources).unwrap().clips().iter().map(|clip| clip.name.clone()).collect();
    assert_eq!(names.len(), 1);
    std::fs::write(clips.join("c1/0.png"), b"no image").unwrap();
    let mut skipped = Vec::new();
    let error = pack(&mut skipped).unwrap_err();
    assert!(skipped.is_empty() && error.to_string().contains("2 of 2 clips"), "{error}");
}

fn super_config(from: &str) -> DataConfig {
    config(vec![source("clips", SourceKind::Clips, &[from])])
}

fn pack_in(config: &DataConfig, folder: &Path) -> Result<PathBuf, Error> {
    let (path, sources) = (folder.join("other.zip"), config.packed_sources());
    let result =
        write_pack(
            &sources,
            folder,
            &path,
            Overwrite::No,
            None,
            &mut |_| ControlFlow::Continue(()),
        );
    assert!(result.is_ok() || !path.exists(), "a failed pack left a file");
    result.map(|_| path)
}

/// Damage anywhere gives an error, never a panic or other pixels: ZIP and digest know every byte that counts.
#[test]
fn rejects_damaged_packs() {
    let folder = tempfile::tempdir().unwrap();
    files(folder.path());
    let mut sources = super_config("clips/c0").packed_sources();
    sources.push(PackedSource {
        name: "validation".into(),
        lossless: Some(ClipWindow { frames: 2, crop: 20 }),
        ..sources[0].clone()
    });
    let path = pack(&sources, folder.path()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let look = |bytes: &[u8]| {
        let broken = folder.path().join("broken.zip");
        std::fs::write(&broken, bytes).unwrap();
        let pack = Pack::open(&broken, &sources)?;
        let clips = pack.clips().iter().enumerate();
        let frames = clips.flat_map(|(n, clip)| (0..clip.frames).map(move |t| (n, t)));
        Ok::<_, Error>(frames.map(|(n, t)| pack.frame(n, t).values.to_vec()).collect::<Vec<_>>())
    };
    let intact = look(&whole).unwrap();
    for length in (0..whole.len()).step_by(whole.len() / 40) {
        assert!(look(&whole[..length]).is_err(), "{length} bytes of {}", whole.len());
    }
    for i in 0..600 {
        let mut bytes = whole.clone();
        let at = (i * 7919) % bytes.len();
        bytes[at] ^= 1 << (i % 8);
        if let Ok(frames) = look(&bytes) {
            assert!(frames == intact, "byte {at} changes frames");
        }
    }
    assert!(look(b"no archive at all").is_err());
}

/// Writes a pack with another index, and with the given images, all consistent for ZIP.
fn forged(path: &Path, index: &str, images: &[(&str, &[u8])]) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    let options = zip::write::SimpleFileOptions::default();
    for (name, bytes) in [&[("index.json", index.as_bytes())], images].concat() {
        zip.start_file(name, options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap();
}

/// Sizes and counts are checked before anything is allocated for them; old layouts and edited packs are
/// refused.
#[test]
fn rejects_forged_packs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("forged.zip");
    let sources = super_config("clips/c0").packed_sources();
    let source = serde_json::to_string(&sources[0]).unwrap();
    let index = |frames: &str, height: &str| {
        format!(
            "{{\"version\": 2, \"sources\": [{source}], \"clips\": [{{\"source\": \"clips\", \"name\": \"a\",
            \"file_bytes\": 1, \"frames\": {frames}, \"size\": {{\"height\": {height}, \"width\": 16}}}}],
            \"sha256\": \"00\"}}"
        )
    };
    let mut image = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new(&mut image);
    encoder.encode(&[50; 256], 16, 16, image::ExtendedColorType::L8).unwrap();
    let name = "clips/a/000000.jpg";
    let zeros = vec![0; 100_000];
    for (text, index, images) in [
        ("layout is 1", "{\"version\": 1, \"clips\": []}".to_owned(), &[][..]),
        ("index.json", String::new(), &[]),
        ("cannot be", index("0", "16"), &[]),
        ("cannot be", index("1", "0"), &[(name, &image[..])]),
        ("cannot be", index("1", "9999999999999"), &[(name, &image)]),
        ("names 18446744073709551615 images", index("18446744073709551615", "16"), &[]),
        ("names 2 images", index("2", "16"), &[(name, &image)]),
        ("cannot hold 16000000 pixels", index("1", "1000000"), &[(name, &image)]),
        ("exceeds", index("1", "15"), &[(name, &image)]),
        ("another size", index("1", "17"), &[(name, &image)]),
        ("clips/a/000000.jpg", index("1", "16"), &[("clips/b/000000.jpg", &image)]),
        ("more than", index("1", "16"), &[(name, &zeros)]),
        ("digest", index("1", "16"), &[(name, &image)]),
    ] {
        forged(&path, &index, images);
        let error = Pack::open(&path, &sources).unwrap_err();
        let error = format!("{error}");
        assert!(error.contains(text) || text == "index.json", "{text}: {error}");
    }
}
