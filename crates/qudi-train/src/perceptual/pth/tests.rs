//! Files that PyTorch wrote, whole and damaged.
#![allow(clippy::unwrap_used)]

use super::StateDict;
use crate::cases::uniform;
use std::io::Write;
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/perceptual");
    Path::new(folder).join(name)
}

fn expected(name: &str, count: usize) -> Vec<f32> {
    uniform(name, count).into_iter().map(|value| value as f32).collect()
}

#[test]
fn both_layouts_hold_the_same() {
    for name in ["zip.pth", "plain.pth"] {
        let mut file = StateDict::open(&golden(name)).unwrap();
        assert_eq!(file.read("a.weight", &[2, 3]).unwrap(), expected("a.weight", 6));
        assert_eq!(file.read("b.weight", &[3, 2, 1, 1]).unwrap(), expected("b.weight", 6));
        // Two views of one storage.
        let both = expected("both", 10);
        assert_eq!(file.read("both.last", &[6]).unwrap(), both[4..]);
        assert_eq!(file.read("both.first", &[4]).unwrap(), both[..4]);
        for (tensor, shape, reason) in [
            ("missing", &[1][..], "missing"),
            ("a.weight", &[3, 2], "expected [3, 2]"),
            ("half", &[4], "32-bit floats"),
            ("turned", &[2, 3], "in rows"),
            ("bad", &[2], "no numbers"),
        ] {
            let error = file.read(tensor, shape).unwrap_err().to_string();
            assert!(error.contains(reason), "{name}: {error}");
        }
    }
}

#[test]
fn nothing_is_executed() {
    let error = StateDict::open(&golden("code.pth")).err().unwrap().to_string();
    assert!(error.contains("call of `__builtin__ print`"), "{error}");
}

fn open(bytes: &[u8]) -> qudi_core::Result<StateDict> {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    StateDict::open(file.path())
}

#[test]
fn damaged_files_are_refused_or_read_as_they_are() {
    for name in ["zip.pth", "plain.pth"] {
        let whole = std::fs::read(golden(name)).unwrap();
        for length in 0..whole.len() {
            if let Ok(mut file) = open(&whole[..length]) {
                let _ = file.read("a.weight", &[2, 3]);
            }
        }
        for place in 0..whole.len() {
            for bit in [0, 3, 7] {
                let mut bytes = whole.clone();
                bytes[place] ^= 1 << bit;
                if let Ok(mut file) = open(&bytes) {
                    let _ = file.read("both.last", &[6]);
                }
            }
        }
    }
    assert!(open(b"").is_err());
    assert!(open(b"\x80\x02.").is_err());
}

#[test]
fn hostile_pickles_take_neither_stack_nor_memory() {
    // A million nested tuples.
    let mut deep = vec![b'N'];
    deep.resize(1 << 20, 0x85);
    deep.push(b'.');
    assert!(super::pickle::read(&deep).is_ok());
    // A text of four gigabytes, numbers that are none, values from below a mark.
    for bytes in [
        &b"X\xFF\xFF\xFF\xFFabc."[..],
        b"\x8A\xFF.",
        b"NN(\x86t.",
        b"(\x85.",
        b"h\x05.",
        b"R.",
        b"Q.",
    ] {
        assert!(super::pickle::read(bytes).is_err(), "{bytes:?}");
    }
}
