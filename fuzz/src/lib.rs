//! Common part of all targets: writes the bytes to a file, opens it as a capture, and reads some frames.
//!
//! Any result is allowed, except a panic, a hang, or memory beyond libFuzzer's limit.

use qudi_io::capture::{Capture, choose_sum};
use qudi_io::description::{Axes, ReadOptions};

/// Number of frames read from each file.
const FRAMES: u64 = 4;

/// Opens `bytes` as a capture called `name` with variants of `options`: strict and lenient, other axes, one
/// colour channel, one plane of a mosaic, a pedestal.
pub fn read(name: &str, options: &ReadOptions, bytes: &[u8]) {
    let Ok(folder) = tempfile::tempdir_in(if cfg!(target_os = "linux") { "/dev/shm" } else { "." })
    else {
        return;
    };
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).expect("a temporary file");
    let plain = || options.clone();
    let cfa = "rggb@0,1".parse().ok();
    let variants = [
        plain(),
        ReadOptions { lenient: true, ..plain() },
        ReadOptions { axes: Some(Axes::Hwt), ..plain() },
        ReadOptions { channel: Some(1), ..plain() },
        ReadOptions { channel: Some(2), cfa, ..plain() },
        ReadOptions { offset: Some(3.0), threshold: Some(2.0), sum: Some(2), ..plain() },
    ];
    for options in variants {
        let Ok(mut capture) = Capture::open(&path, &options, None) else { continue };
        let pixels = capture.size().pixels();
        if pixels > 1 << 22 {
            continue;
        }
        let mut counts = vec![0; pixels];
        for frame in 0..capture.frames().min(FRAMES) {
            let _ = capture.read(frame, &mut counts);
        }
        let mut sums = vec![0; pixels];
        let _ = capture.total(0..capture.frames().min(FRAMES), &mut sums);
        if capture.summed() == 1 && capture.frames() < 1000 && pixels < 1 << 14 {
            let _ = choose_sum(&mut capture);
        }
    }
}

/// Returns options that name a format.
pub fn format(name: &str) -> ReadOptions {
    ReadOptions { format: Some(name.into()), ..ReadOptions::default() }
}
