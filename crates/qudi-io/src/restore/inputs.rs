//! Fingerprints of the files that a run reads, so that it is not resumed with other data.

use crc32fast::Hasher;
use qudi_core::natural_order::natural_order;
use qudi_core::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// Largest size in bytes of files that are read whole.
const MAX_WHOLE_BYTES: u64 = 64 << 20;

/// Number of blocks in which larger files are sampled, evenly spread, with the first and the last.
const SAMPLED_BLOCKS: u64 = 64;

/// Bytes of a block.
const BLOCK_BYTES: u64 = 1 << 16;

/// Levels of folders that are read, as for captures.
const FOLDER_DEPTH: usize = 3;

/// The content of a file, or of all files of a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fingerprint {
    /// Size in bytes.
    pub bytes: u64,
    /// Time of the last change in seconds since 1970, if the file system knows it.
    pub modified: Option<u64>,
    /// CRC-32 of the content, or of blocks spread over it.
    pub crc32: u32,
    /// True if the CRC-32 covers the whole content.
    pub whole: bool,
}

impl Fingerprint {
    /// Reads the fingerprint of the file or folder at `path`.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, or is neither a regular file nor a folder.
    pub fn of(path: &Path) -> Result<Self> {
        if !path.is_dir() {
            qudi_core::regular_file::require_regular(path, "read the input")?;
        }
        let mut files = Vec::new();
        list(path, FOLDER_DEPTH, &mut files)?;
        files.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
        let mut hasher = Hasher::new();
        let mut bytes = 0u64;
        let mut modified = None;
        let mut lengths = Vec::with_capacity(files.len());
        for file in &files {
            let found = file.metadata().map_err(|e| Error::io("read", file, e))?;
            let time = found.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
            modified = modified.max(time.map(|t| t.as_secs()));
            bytes = bytes.saturating_add(found.len());
            lengths.push(found.len());
            if let Ok(name) = file.strip_prefix(path) {
                hasher.update(name.to_string_lossy().as_bytes());
                hasher.update(&found.len().to_le_bytes());
            }
        }
        let whole = bytes <= MAX_WHOLE_BYTES;
        // Of many large files, only some are sampled, so that the work stays bounded.
        let every = if whole { 1 } else { files.len().div_ceil(SAMPLED_BLOCKS as usize) };
        let blocks = (SAMPLED_BLOCKS / files.len().max(1) as u64).max(1);
        for (file, length) in files.iter().zip(lengths).step_by(every) {
            let hashed = if whole {
                hash_all(file, &mut hasher)
            } else {
                hash_some(file, length, blocks, &mut hasher)
            };
            hashed.map_err(|e| Error::io("read", file, e))?;
        }
        Ok(Self { bytes, modified, crc32: hasher.finalize(), whole })
    }

    /// Returns true if `other` has the same content. Times are compared only where the content was sampled.
    pub fn agrees(&self, other: &Self) -> bool {
        let content =
            (self.bytes, self.crc32, self.whole) == (other.bytes, other.crc32, other.whole);
        content && (self.whole || self.modified == other.modified)
    }
}

impl std::fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} bytes with CRC-32 {:08x}", self.bytes, self.crc32)?;
        match self.modified {
            Some(time) if !self.whole => write!(f, ", changed at {time} s since 1970"),
            _ => Ok(()),
        }
    }
}

fn list(path: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<()> {
    if path.is_file() {
        files.push(path.to_owned());
        return Ok(());
    }
    let io = |e| Error::io("list the folder", path, e);
    for entry in std::fs::read_dir(path).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.is_file() || (depth > 1 && path.is_dir()) {
            list(&path, depth - 1, files)?;
        }
    }
    Ok(())
}

fn hash_all(path: &Path, hasher: &mut Hasher) -> std::io::Result<()> {
    let mut file = File::open(path)?;
    let mut piece = vec![0; BLOCK_BYTES as usize];
    loop {
        let n = file.read(&mut piece)?;
        if n == 0 {
            return Ok(());
        }
        hasher.update(&piece[..n]);
    }
}

/// Hashes `blocks` blocks of a file of `length` bytes.
fn hash_some(path: &Path, length: u64, blocks: u64, hasher: &mut Hasher) -> std::io::Result<()> {
    let mut file = File::open(path)?;
    let last = length.saturating_sub(BLOCK_BYTES);
    for block in 0..blocks {
        let at = if blocks > 1 {
            (u128::from(last) * u128::from(block) / u128::from(blocks - 1)) as u64
        } else {
            0
        };
        let mut piece = Vec::new();
        file.seek(SeekFrom::Start(at))?;
        (&mut file).take(BLOCK_BYTES).read_to_end(&mut piece)?;
        hasher.update(&piece);
    }
    Ok(())
}

/// The fingerprints of all files that a run reads, by the name of the option that gave them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Inputs(BTreeMap<String, Fingerprint>);

impl Inputs {
    /// Adds the file or folder at `path`, given as `option`, such as `capture`, `mask`, `dcr` or `weights`.
    ///
    /// # Errors
    /// As [`Fingerprint::of`].
    pub fn add(&mut self, option: &str, path: &Path) -> Result<()> {
        self.0.insert(option.to_owned(), Fingerprint::of(path)?);
        Ok(())
    }

    /// Returns the first input that differs from an earlier run: its name, and both fingerprints.
    pub(super) fn difference(&self, earlier: &Self) -> Option<(String, String, String)> {
        let words = |found: Option<&Fingerprint>| {
            found.map_or_else(|| "not noted".to_owned(), ToString::to_string)
        };
        earlier.0.keys().chain(self.0.keys()).find_map(|option| {
            let (was, is) = (earlier.0.get(option), self.0.get(option));
            let agree = match (was, is) {
                (Some(was), Some(is)) => is.agrees(was),
                (was, is) => was.is_none() && is.is_none(),
            };
            (!agree).then(|| (option.clone(), words(was), words(is)))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_agree_for_copies_only() {
        let scratch = tempfile::tempdir().unwrap();
        let path = |name: &str| scratch.path().join(name);
        std::fs::write(path("a"), [1, 2, 3]).unwrap();
        std::fs::write(path("copy"), [1, 2, 3]).unwrap();
        std::fs::write(path("other"), [1, 2, 4]).unwrap();
        let of = |name: &str| Fingerprint::of(&path(name)).unwrap();
        assert!(of("a").whole && of("a").agrees(&of("copy")));
        assert!(!of("a").agrees(&of("other")));
    }

    #[test]
    fn folders_differ_in_names_and_content() {
        let scratch = tempfile::tempdir().unwrap();
        let of = |name: &str| Fingerprint::of(&scratch.path().join(name)).unwrap();
        for (folder, file, byte) in [("a", "x", 1), ("b", "x", 1), ("c", "y", 1), ("d", "x", 2)] {
            std::fs::create_dir(scratch.path().join(folder)).unwrap();
            std::fs::write(scratch.path().join(folder).join(file), [byte]).unwrap();
        }
        assert!(of("a").agrees(&of("b")));
        assert!(!of("a").agrees(&of("c")) && !of("a").agrees(&of("d")));
    }

    #[test]
    fn large_files_are_sampled_and_compared_by_time_too() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("large");
        File::create(&path).unwrap().set_len(MAX_WHOLE_BYTES + 1).unwrap();
        let found = Fingerprint::of(&path).unwrap();
        assert!(!found.whole && found.agrees(&found));
        let later = Fingerprint { modified: found.modified.map(|t| t + 1), ..found };
        assert!(!found.agrees(&later));
    }
}
