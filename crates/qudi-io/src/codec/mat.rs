//! MATLAB captures: `part_1.mat`, `part_2.mat`, ... with `info.json`, or one file.

pub(super) mod file;

use super::array::{Array, Hints, Place, Stored};
use super::{Format, Recognition};
use crate::codec::mat::file::{MatArray, arrays, is_level_5};
use crate::description::{Axes, CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::frames::chain::Chain;
use crate::recognition::{Probe, stem};
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};

pub(crate) const FORMAT: Format = Format {
    name: "mat",
    title: "MATLAB arrays (level 5)",
    options: super::ARRAYS_OPTIONS,
    probe: |probe| {
        if probe.is_folder {
            let parts = !parts(probe)?.is_empty();
            let info = probe.path.join("info.json").is_file();
            let reasons: &[&str] =
                if info { &["part_<N>.mat", "info.json"] } else { &["part_<N>.mat"] };
            return Ok(parts.then(|| Recognition::new(Certainty::Certain, reasons)));
        }
        let found = is_level_5(&probe.head);
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["MATLAB's header"])))
    },
    open,
};

/// Variable that converters of SwissSPAD2 write.
const CUSTOMARY_VARIABLE: &str = "OUTPUT";

fn parts(probe: &Probe) -> Result<Vec<PathBuf>> {
    let mut files = probe.files(&["mat"])?;
    files.retain(|file| stem(file).starts_with("part_") && file.parent() == Some(&probe.path));
    Ok(files)
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    if !probe.is_folder {
        let array = choose(&probe.path, options)?;
        info.reasons.push(format!("variable `{}`", array.name));
        return frames(&probe.path, array, options, info);
    }
    let files = parts(probe)?;
    let mut lengths = Vec::new();
    let mut size = None;
    for path in &files {
        let part = frames(path, choose(path, options)?, options, info)?;
        if *size.get_or_insert(part.size()) != part.size() {
            return Err(Error::data(
                format!("a part of {} among parts of another size", part.size()),
                path,
                "parts of one capture have one size",
            ));
        }
        lengths.push(part.frames());
    }
    let Some(size) = size else {
        return Err(Error::data("no part_<N>.mat in it", &probe.path, "name one .mat file"));
    };
    info.notes.dedup();
    check_info(&probe.path.join("info.json"), files.len(), lengths.iter().sum(), options, info)?;
    let (options, template) = (options.clone(), info.clone());
    let opener = move |part: usize| {
        frames(&files[part], choose(&files[part], &options)?, &options, &mut template.clone())
    };
    Ok(Box::new(Chain::new(size, &lengths, Box::new(opener))))
}

/// Compares the frames with the converter's notes.
fn check_info(
    path: &Path,
    parts: usize,
    frames: u64,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<()> {
    let Ok(text) = read_limited(path, RECORD_BYTES, "read the notes") else { return Ok(()) };
    let Ok(noted) = serde_json::from_slice::<serde_json::Value>(&text) else {
        info.notes.push("info.json is not JSON: ignored".to_owned());
        return Ok(());
    };
    let promised = noted["no_parts"].as_u64();
    let missing = promised.is_some_and(|promised| promised != parts as u64);
    if missing && !options.lenient {
        return Err(Error::data(
            format!("{parts} parts, where info.json notes {}", promised.unwrap_or(0)),
            path,
            "copy the missing parts, or read those that are there with `lenient`",
        ));
    }
    // Some converters note the frames of a part, others the frames of the capture.
    let per_part = noted["no_frames"].as_u64().unwrap_or(frames);
    if per_part != frames && per_part != frames / parts as u64 {
        info.notes.push(format!("info.json notes {per_part} frames, the parts hold {frames}"));
    }
    Ok(())
}

fn choose(path: &Path, options: &ReadOptions) -> Result<MatArray> {
    let found = arrays(path)?;
    let listed = || {
        let names: Vec<_> = found.iter().map(|a| format!("{} {:?}", a.name, a.dims)).collect();
        names.join(", ")
    };
    if let Some(wanted) = &options.array {
        return found
            .iter()
            .find(|a| a.name == *wanted)
            .cloned()
            .ok_or_else(|| Error::data(format!("no variable `{wanted}` in it"), path, listed()));
    }
    if found.iter().any(|a| a.name == "imbs") {
        return Err(Error::data(
            "a simulated colour-filter capture (`imbs`)",
            path,
            "read it with `array imbs`, and its pattern beside it, as in `cfa rggb@0,0`",
        ));
    }
    let captures: Vec<_> = found.iter().filter(|a| a.dims.len() >= 3).collect();
    let customary = found.iter().find(|a| a.name == CUSTOMARY_VARIABLE);
    match (customary, captures.as_slice()) {
        (Some(array), _) => Ok(array.clone()),
        (None, [one]) => Ok((*one).clone()),
        (None, []) if found.is_empty() => Err(Error::data(
            "it holds no numeric arrays; structs and cells are not looked into",
            path,
            "save the array itself, as with `frames = s.frames; save('NAME.mat', 'frames')`",
        )),
        (None, []) => Err(Error::data(
            format!("no array of frames in it; there are: {}", listed()),
            path,
            "a capture is an array of height x width x frames; dark maps go to `dcr`",
        )),
        (None, _) => Err(Error::data(
            format!("several arrays could be the capture: {}", listed()),
            path,
            "name one with `array`",
        )),
    }
}

fn frames(
    path: &Path,
    array: MatArray,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let place = if let Some((start, available)) = array.in_place() {
        Place::File { start, available, checksum: None }
    } else {
        array.refuse_bomb(path)?;
        Place::Stream(array.opener(path))
    };
    let array = Array {
        path: path.to_owned(),
        sample: array.sample,
        shape: array.dims,
        fortran: true,
        axes: Axes::Hwt,
        place,
    };
    // Samples of MATLAB arrays are never packed.
    let hints = Hints { stored: Stored::Counts, ..Hints::default() };
    array.open(options, &hints, info)
}
