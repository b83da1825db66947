//! A folder of numbered parts, each a stack of frames: multi-page TIFF, NumPy arrays, or HDF5 files.

use super::tiff::{is_of_set, is_stack};
use super::{Format, Recognition};
use crate::description::{CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::chain::Chain;
use crate::recognition::{Numbered, Probe, numbered};
use qudi_core::{Error, Result};
use std::path::PathBuf;

pub(crate) const FORMAT: Format = Format {
    name: "parts",
    title: "folder of stacks",
    options: super::ARRAYS_OPTIONS,
    probe: |probe| {
        let files = if probe.is_folder { files(probe)? } else { Vec::new() };
        let reason = "numbered stacks in the folder";
        Ok((!files.is_empty()).then(|| Recognition::new(Certainty::Likely, &[reason])))
    },
    open,
};

/// Returns true if a folder holds stacks, whose files are no single frames.
pub(super) fn holds_stacks(probe: &Probe) -> Result<bool> {
    Ok(probe.is_folder && !files(probe)?.is_empty())
}

/// Lists the parts in a folder; none if they are single frames or captures of their own.
fn files(probe: &Probe) -> Result<Vec<PathBuf>> {
    for extensions in [["tif", "tiff"], ["npy", "npy"], ["npz", "npz"], ["h5", "hdf5"]] {
        let mut files = probe.files(&extensions)?;
        files.retain(|file| file.parent() == Some(&probe.path));
        let stacks = extensions[0] != "tif" || files.iter().take(2).any(|file| is_stack(file));
        let beside = probe.path.join("transforms.json").is_file();
        if !stacks || beside || files.is_empty() {
            continue;
        }
        let alike = extensions[0] == "tif" || are_numbered(&files);
        if alike {
            return Ok(files);
        }
    }
    Ok(Vec::new())
}

/// Returns true if names differ in one number only.
fn are_numbered(files: &[PathBuf]) -> bool {
    let rest = |file: &PathBuf| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.chars().filter(|c| !c.is_ascii_digit()).collect::<String>()
    };
    let numbered =
        |file: &PathBuf| rest(file).len() < file.file_name().map_or(0, std::ffi::OsStr::len);
    files.len() > 1 && files.iter().all(|file| rest(file) == rest(&files[0]) && numbered(file))
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let Numbered { files, notes, gaps } = numbered(files(probe)?);
    let Some(first) = files.first() else {
        return Err(Error::data("the folder holds no stacks", &probe.path, "name one file"));
    };
    let (part, about) = super::open(first, options)?;
    if is_of_set(first) {
        // Its first file brings all the others.
        *info = CaptureInfo { reasons: std::mem::take(&mut info.reasons), ..about };
        return Ok(part);
    }
    let size = part.size();
    let mut lengths = vec![part.frames()];
    for file in &files[1..] {
        let (part, other) = super::open(file, options)?;
        if part.size() != size || other.max_count != about.max_count {
            return Err(Error::data(
                format!("a part of {} or of another depth among parts of {size}", part.size()),
                file,
                "parts of one capture have one size and one depth",
            ));
        }
        lengths.push(part.frames());
    }
    *info = CaptureInfo {
        format: info.format,
        title: info.title,
        certainty: info.certainty,
        reasons: std::mem::take(&mut info.reasons),
        ..about
    };
    let gap =
        |(part, missing): (usize, u64)| (lengths[..part].iter().sum(), missing * lengths[part - 1]);
    info.gaps = gaps.into_iter().map(gap).collect();
    info.notes.extend(notes);
    info.notes.push(format!("{} parts are read one after the other", files.len()));
    let options = options.clone();
    let opener = move |part: usize| Ok(super::open(&files[part], &options)?.0);
    Ok(Box::new(Chain::new(size, &lengths, Box::new(opener))))
}
