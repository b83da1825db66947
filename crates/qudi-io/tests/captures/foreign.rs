//! Captures that other programs wrote: `tests/golden/captures`, made by
//! `tests/golden/generate/captures.py`. All hold the same 6 frames.

use crate::{counts, open, plain, refusal};
use qudi_io::description::{Certainty, MaskChoice, PackAxis, ReadOptions};
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    let folder = match name.rsplit('.').next() {
        Some("tif") => "tiff",
        Some("mat") => "mat",
        Some("h5") => "hdf5",
        _ => "",
    };
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/captures");
    captures.join(folder).join(name)
}

fn frames(name: &str, options: &ReadOptions) -> Vec<Vec<u16>> {
    let mut capture = open(&golden(name), options).unwrap_or_else(|e| panic!("{name}: {e}"));
    assert_eq!((capture.size().height, capture.size().width), (12, 20), "{name}");
    // Backwards first: random access must not depend on order.
    let mut one = vec![0; 240];
    capture.read(capture.frames() - 1, &mut one).unwrap();
    let frames = counts(&mut capture);
    assert_eq!(*frames.last().unwrap(), one, "{name}");
    let mut sums = vec![0; 240];
    capture.total(1..5, &mut sums).unwrap();
    let expected: Vec<u32> =
        (0..240).map(|i| frames[1..5].iter().map(|f| u32::from(f[i])).sum()).collect();
    assert_eq!(sums, expected, "{name}");
    frames
}

/// Read by nothing but the length of its header: 128 bytes.
fn expected(name: &str) -> Vec<Vec<u16>> {
    let bytes = std::fs::read(golden(name)).unwrap();
    bytes[128..].chunks(240).map(|f| f.iter().map(|&b| u16::from(b)).collect()).collect()
}

#[test]
fn every_file_holds_the_same_frames() {
    let three_bit = expected("counts.npy");
    assert_eq!(three_bit.len(), 6);
    for name in [
        "counts.npy",
        "fortran.npy",
        "wide.npy",
        "counts.npy.gz",
        "stored.npz",
        "deflated.npz",
        "plain.mat",
        "compressed.mat",
        "pages.tif",
        "imagej.tif",
        "deflate.tif",
        "float.tif",
        "means.tif",
    ] {
        assert_eq!(frames(name, &plain()), three_bit, "{name}");
    }
    let binary = expected("bits.npy");
    for name in ["bits.npy", "parts", "images", "visionsim1", "visionsim2", "bilevel.tif"] {
        assert_eq!(frames(name, &plain()), binary, "{name}");
    }
}

#[cfg(feature = "hdf5")]
#[test]
fn reads_hdf5_captures() {
    let three_bit = expected("counts.npy");
    for name in ["chunked.h5", "contiguous.h5", "soft.h5", "matlab73.mat", "mono.ubi.h5"] {
        assert_eq!(frames(name, &plain()), three_bit, "{name}");
    }
    let mono = open(&golden("mono.ubi.h5"), &plain()).unwrap();
    assert_eq!((mono.max_count(), mono.fps()), (Some(7), Some(10_000.0)));
    let mosaic = open(&golden("cfa.ubi.h5"), &plain()).unwrap();
    let colours = mosaic.filter().unwrap().shares();
    assert_eq!(mosaic.info().cfa.as_ref().map(ToString::to_string), Some("rggb@0,0".into()));
    assert!((colours[1] - 0.5).abs() < 0.03, "{colours:?}");
    let trimmed = ReadOptions { size: Some("12x20".parse().unwrap()), ..plain() };
    assert_eq!(frames("packed.h5", &trimmed)[6 * 39..], expected("bits.npy"));
}

#[cfg(feature = "hdf5")]
#[test]
fn links_to_other_hdf5_files_are_named_and_not_followed() {
    for (name, files) in [("master.h5", "chunked.h5, contiguous.h5"), ("mixed.h5", "contiguous.h5")]
    {
        let words = refusal(open(&golden(name), &plain()));
        assert!(words.contains(&format!("not followed: {files}")), "{words}");
        assert!(words.contains("numpy.concatenate") && words.contains("`array`"), "{words}");
    }
    // What lies in the file is read by name.
    let inside = ReadOptions { array: Some("data_000001".into()), ..plain() };
    assert_eq!(
        counts(&mut open(&golden("mixed.h5"), &inside).unwrap()),
        expected("counts.npy")[..2]
    );
    // A folder with nothing but the data is read part by part.
    let folder = tempfile::tempdir().unwrap();
    for n in 1..=3 {
        std::fs::copy(golden("chunked.h5"), folder.path().join(format!("data_{n}.h5"))).unwrap();
    }
    let mut capture = open(folder.path(), &plain()).unwrap();
    assert_eq!(counts(&mut capture), vec![expected("counts.npy"); 3].concat());
}

#[cfg(not(feature = "hdf5"))]
#[test]
fn explains_builds_without_hdf5() {
    assert!(refusal(open(&golden("chunked.h5"), &plain())).contains("--features hdf5"));
}

#[test]
fn info_says_what_is_known() {
    let info = |name: &str| open(&golden(name), &plain()).unwrap().info().clone();
    for name in ["counts.npy", "stored.npz", "plain.mat", "pages.tif", "visionsim1", "parts"] {
        assert_eq!(info(name).certainty, Certainty::Certain, "{name}");
    }
    assert_eq!(info("images").certainty, Certainty::Likely);
    assert_eq!(info("images").max_count, Some(1));
    assert_eq!(info("means.tif").max_count, Some(7));
    assert_eq!(info("visionsim1").packing.unwrap().axis, PackAxis::Height);
    assert!(info("stored.npz").reasons.contains(&"array `spk`".to_owned()));
}

#[test]
fn asks_for_what_the_file_leaves_open() {
    let words = refusal(open(&golden("two.npz"), &plain()));
    assert!(words.contains("left") && words.contains("`array`"), "{words}");
    let left = ReadOptions { array: Some("left".into()), ..plain() };
    assert_eq!(frames("two.npz", &left), expected("counts.npy"));
    assert!(refusal(open(&golden("bayer.mat"), &plain())).contains("`array imbs`"));
    let mosaic = ReadOptions { array: Some("imbs".into()), ..plain() };
    assert_eq!(frames("bayer.mat", &mosaic), expected("counts.npy"));
    assert!(refusal(open(&golden("visionsim_colour"), &plain())).contains("colour"));
    assert!(refusal(open(&golden("rgb.tif"), &plain())).contains("colour"));
    assert!(refusal(open(&golden("dcr.mat"), &plain())).contains("`dcr`"));
    let folder = crate::scratch();
    crate::write(folder.path(), "run/binary.npy", b"x");
    assert!(refusal(open(folder.path(), &plain())).contains("binary.npy"));
}

#[test]
fn matlab_s_dark_map_names_hot_pixels() {
    let options = ReadOptions {
        dcr: Some(golden("dcr.mat")),
        mask: MaskChoice::Auto,
        ..ReadOptions::default()
    };
    let capture = open(&golden("counts.npy"), &options).unwrap();
    // light > 0.75 in the generator: the last columns of the last rows.
    let hot = &capture.bad_pixels().hot;
    assert_eq!(hot.last(), Some(&239));
    assert!(!hot.is_empty() && hot.len() < 10, "{hot:?}");
    assert!(capture.info().notes.iter().any(|r| r.contains("frame rate is unknown")));
}

/// Cut anywhere, a file is an error or fewer frames, never a panic.
#[test]
fn truncated_files_do_not_panic() {
    let folder = crate::scratch();
    for name in [
        "counts.npy",
        "counts.npy.gz",
        "stored.npz",
        "deflated.npz",
        "plain.mat",
        "compressed.mat",
        "pages.tif",
        "imagej.tif",
        "deflate.tif",
        #[cfg(feature = "hdf5")]
        "chunked.h5",
    ] {
        let whole = std::fs::read(golden(name)).unwrap();
        for cut in (0..whole.len()).step_by(whole.len() / 40 + 1) {
            let path = crate::write(folder.path(), name, &whole[..cut]);
            for lenient in [false, true] {
                let options = ReadOptions { lenient, ..plain() };
                let Ok(mut capture) = open(&path, &options) else { continue };
                let mut one = vec![0; capture.size().pixels()];
                for frame in 0..capture.frames() {
                    let _ = capture.read(frame, &mut one);
                }
            }
        }
    }
}

/// A named pipe among the files would keep a reader waiting for ever.
#[cfg(unix)]
#[test]
fn skips_pipes_in_a_folder() {
    let folder = crate::scratch();
    let made =
        std::process::Command::new("mkfifo").arg(folder.path().join("filename0.bin")).status();
    assert!(made.unwrap().success());
    assert!(refusal(open(folder.path(), &plain())).contains("no capture in a known format"));
}
