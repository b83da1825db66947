//! Every format, from files made bit by bit, and from files that other programs wrote.
#![allow(clippy::unwrap_used)]

#[path = "captures/arrays.rs"]
mod arrays;
#[path = "captures/bit_order.rs"]
mod bit_order;
#[path = "captures/cameras.rs"]
mod cameras;
#[path = "captures/damage.rs"]
mod damage;
#[path = "captures/folders.rs"]
mod folders;
#[path = "captures/foreign.rs"]
mod foreign;
#[path = "captures/options.rs"]
mod options;
#[path = "captures/pipes.rs"]
mod pipes;
#[path = "captures/pixels.rs"]
mod pixels;

use qudi_core::Error;
use qudi_io::capture::Capture;
use qudi_io::description::{MaskChoice, ReadOptions};
use std::path::{Path, PathBuf};

/// Creates a folder for a test, deleted when dropped.
pub(crate) fn scratch() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

pub(crate) fn write(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, bytes).unwrap();
    path
}

/// Options that leave pixels alone.
pub(crate) fn plain() -> ReadOptions {
    ReadOptions { mask: MaskChoice::None, ..ReadOptions::default() }
}

pub(crate) fn open(path: &Path, options: &ReadOptions) -> Result<Capture, Error> {
    Capture::open(path, options, None)
}

/// All frames, one after the other.
pub(crate) fn counts(capture: &mut Capture) -> Vec<Vec<u16>> {
    let pixels = capture.size().pixels();
    (0..capture.frames())
        .map(|frame| {
            let mut counts = vec![0; pixels];
            capture.read(frame, &mut counts).unwrap();
            counts
        })
        .collect()
}

/// Returns the message of an expected error, with its remedy.
pub(crate) fn refusal(result: Result<Capture, Error>) -> String {
    let error = result.expect_err("to be refused");
    format!("{error}; {}", error.help().unwrap_or_default())
}

/// Pixels that look like a picture: smooth, with an edge, and noise of their own.
pub(crate) fn scene(frames: usize, height: usize, width: usize, seed: u64) -> Vec<Vec<u16>> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut uniform = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let light = |y: usize, x: usize| {
        let (v, u) = (y as f64 / height as f64, x as f64 / width as f64);
        let disc = (v - 0.4).powi(2) + (u - 0.6).powi(2) < 0.05;
        0.08 + 0.25 * u + 0.1 * (9.0 * v).sin().abs() + if disc { 0.35 } else { 0.0 }
    };
    let pixels = height * width;
    (0..frames)
        .map(|_| (0..pixels).map(|i| u16::from(uniform() < light(i / width, i % width))).collect())
        .collect()
}

/// Eight pixels to the byte along rows, the first in the highest or the lowest bit.
pub(crate) fn pack(frame: &[u16], width: usize, lsb: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    for row in frame.chunks(width) {
        for eight in row.chunks(8) {
            let mut byte = 0;
            for (i, &pixel) in eight.iter().enumerate() {
                byte |= (pixel as u8) << if lsb { i } else { 7 - i };
            }
            bytes.push(byte);
        }
    }
    bytes
}

/// Encodes a `.npy` as NumPy writes it.
pub(crate) fn npy(descr: &str, fortran: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header =
        format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}
