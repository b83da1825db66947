//! HDF5: one dataset of frames, MATLAB 7.3 arrays, and Ubicept's `.ubi.h5`, whose frames are
//! datasets named by numbers.

mod guard;
mod links;

use super::array::{Array, Hints, Place};
use super::{Format, Recognition};
use crate::codec::hdf5::guard::{Checked, Hdf5};
use crate::description::{Axes, CaptureInfo, Certainty, ReadOptions};
use crate::frames::CountFrames;
use crate::recognition::Probe;
use hdf5_pure::{Datatype, DatatypeByteOrder};
use links::linked_files;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::path::Path;

pub(crate) const FORMAT: Format = Format {
    name: "hdf5",
    title: "HDF5 or MATLAB 7.3",
    options: super::ARRAYS_OPTIONS,
    probe: |probe| {
        let magic = b"\x89HDF\r\n\x1a\n";
        let found = [0, 512, 1024, 2048]
            .iter()
            .any(|&at: &usize| probe.head.get(at..at + 8).is_some_and(|bytes| bytes == magic));
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["HDF5's signature"])))
    },
    open,
};

/// A dataset that could be a capture or a frame of one.
struct Candidate {
    path: String,
    sample: Sample,
    shape: Vec<usize>,
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = &probe.path;
    let damaged = |e: String| damaged(&e, path);
    let file = Hdf5::open(path).map_err(damaged)?;
    let mut found = Vec::new();
    file.walk(&mut |name, dataset| {
        if let (Ok(datatype), Ok(shape)) = (dataset.datatype(), dataset.shape())
            && let Some(sample) = sample(&datatype)
            && shape.iter().all(|&d| d > 0 && usize::try_from(d).is_ok())
        {
            let shape = shape.iter().map(|&d| d as usize).collect();
            found.push((Candidate { path: name, sample, shape }, dataset));
        }
    })
    .map_err(damaged)?;
    // What lies in other files would be missing without a word.
    let links = if options.array.is_none() { linked_files(path) } else { Vec::new() };
    if !links.is_empty() {
        return Err(Error::data(
            format!(
                "it links to datasets in other files, which are not followed: {}",
                links.join(", ")
            ),
            path,
            "give one of these files, or a folder with nothing but them; read a dataset that lies in this one with `array`; or merge them in Python: numpy.save('capture.npy', numpy.concatenate([file[name] for name in DATASETS]))",
        ));
    }
    found.sort_by(|(a, _), (b, _)| qudi_core::natural_order::natural_order(&a.path, &b.path));
    if options.array.is_none() {
        photon_hdf5(&found, path)?;
    }
    let numbered = |c: &Candidate| {
        let name = c.path.rsplit('/').next().unwrap_or_default();
        !name.is_empty()
            && name.chars().all(|c| c.is_ascii_digit())
            && matches!(c.shape[..], [_, _] | [_, _, 1] | [_, _, 1, 1])
    };
    let frames: Vec<usize> = (0..found.len()).filter(|&i| numbered(&found[i].0)).collect();
    if options.array.is_none() && frames.len() > 1 {
        metadata(&file, &found[frames[0]].0.path, options, info, path)?;
        info.reasons.push(format!("{} datasets named by numbers", frames.len()));
        let sample = found[frames[0]].0.sample;
        let shape = found[frames[0]].0.shape.clone();
        let mut keep = frames.iter().peekable();
        let mut checked = Vec::with_capacity(frames.len());
        for (i, (candidate, dataset)) in found.into_iter().enumerate() {
            if keep.peek() != Some(&&i) {
                continue;
            }
            keep.next();
            if candidate.sample != sample || candidate.shape != shape {
                return Err(damaged(format!(
                    "{} differs from the frames before it",
                    candidate.path
                )));
            }
            checked.push(file.check(dataset).map_err(damaged)?);
        }
        let shape = vec![checked.len(), shape[0], shape[1]];
        return numbered_frames(file, checked, sample, shape, path).open(
            &options.of_container(info.cfa.is_some()),
            &Hints::default(),
            info,
        );
    }
    let at = choose(&found.iter().map(|(c, _)| c).collect::<Vec<_>>(), options, path)?;
    let (candidate, dataset) = found.swap_remove(at);
    info.reasons.push(format!("dataset {}", candidate.path));
    metadata(&file, &candidate.path, options, info, path)?;
    let matlab = file.attribute(&candidate.path, "MATLAB_class").is_some();
    let checked = file.check(dataset).map_err(damaged)?;
    let owned = path.clone();
    let group = checked.group;
    let fetch = move |first, count| {
        file.rows(&checked, first, count).map_err(|e| self::damaged(&e, &owned))
    };
    let array = Array {
        path: path.clone(),
        sample: candidate.sample,
        shape: candidate.shape,
        fortran: false,
        // MATLAB's height x width x frames lies in the file as frames x width x height.
        axes: if matlab { Axes::Twh } else { Axes::Thw },
        place: Place::Fetch { fetch: Box::new(fetch), group },
    };
    array.open(&options.of_container(info.cfa.is_some()), &Hints::default(), info)
}

fn damaged(e: &str, path: &Path) -> Error {
    Error::data(
        format!("not a readable HDF5 file: {e}"),
        path,
        "if h5py opens it, save the frames in Python: numpy.save('capture.npy', file[DATASET])",
    )
}

fn numbered_frames(
    file: Hdf5,
    checked: Vec<Checked>,
    sample: Sample,
    shape: Vec<usize>,
    path: &Path,
) -> Array {
    let owned = path.to_owned();
    let fetch = move |first: u64, count: u64| {
        let mut bytes = Vec::new();
        for frame in &checked[first as usize..(first + count) as usize] {
            let rows = frame.shape.first().copied().unwrap_or(0);
            let read = file.rows(frame, 0, rows).map_err(|e| damaged(&e, &owned))?;
            bytes.extend(read);
        }
        Ok(bytes)
    };
    Array {
        path: path.to_owned(),
        sample,
        shape,
        fortran: false,
        axes: Axes::Thw,
        place: Place::Fetch { fetch: Box::new(fetch), group: 1 },
    }
}

/// Reads Ubicept's description of the camera.
fn metadata(
    file: &Hdf5,
    dataset: &str,
    options: &ReadOptions,
    info: &mut CaptureInfo,
    path: &Path,
) -> Result<()> {
    attributes(file, dataset, info);
    let Some(text) = file.attribute(dataset, "metadata") else { return Ok(()) };
    let Ok(metadata) = serde_json::from_str::<serde_json::Value>(&text) else { return Ok(()) };
    if let Some(pattern) = metadata["cfa_pattern"].as_str() {
        let mono = ["", "none", "mono", "monochrome"].contains(&pattern.to_lowercase().as_str());
        if !mono {
            info.cfa = pattern.parse().ok();
            if info.cfa.is_none() && options.cfa.is_none() {
                return Err(Error::data(
                    format!("a capture behind a colour filter array ({pattern})"),
                    path,
                    "say how its tiles lie, as in `cfa rggb@0,0`",
                ));
            }
        }
    }
    let summed = metadata["polycam_metadata"]["num_integrated_binary_frames"].as_u64();
    if let Some(summed) = summed.and_then(|n| u16::try_from(n).ok()).filter(|&n| n > 0) {
        info.max_count = Some(summed);
    }
    let rate = &metadata["node_history"][0]["schedule"]["base_schedule"]["binary_frame_rate_fps"];
    info.fps = rate.as_f64().map(|fps| fps / f64::from(info.max_count.unwrap_or(1)));
    Ok(())
}

/// Reads frame rate and depth from attributes of the dataset, its groups or the file, by their usual names.
fn attributes(file: &Hdf5, dataset: &str, info: &mut CaptureInfo) {
    let number = |names: &[&str]| {
        let found = names.iter().find_map(|name| file.number(dataset, name));
        found.filter(|value| value.is_finite() && *value > 0.0)
    };
    if let Some(fps) = number(&["fps", "frame_rate", "frame_rate_hz", "framerate", "FrameRate"]) {
        info.fps = Some(fps);
        info.reasons.push(format!("attribute: {fps} frames per second"));
    }
    let bits = number(&["bits", "bit_depth", "bitdepth", "BitDepth"]);
    if let Some(bits) = bits.filter(|bits| bits.fract() == 0.0 && *bits <= 16.0) {
        info.max_count = Some(((1u32 << bits as u32) - 1) as u16);
        info.reasons.push(format!("attribute: counts of {bits} bits"));
    }
}

/// Returns the error of a file of single photons with time stamps (Photon-HDF5, Ingargiola et al. 2016).
fn photon_hdf5(found: &[(Candidate, hdf5_pure::Dataset)], path: &Path) -> Result<()> {
    let stamps =
        found.iter().any(|(c, _)| c.path.contains("photon_data") && c.path.ends_with("timestamps"));
    if !stamps {
        return Ok(());
    }
    Err(Error::data(
        "a Photon-HDF5 file: arrival times of single photons, no frames",
        path,
        "bin its photons into frames first, as with `phconvert` in Python, and save them with numpy.save",
    ))
}

fn choose(found: &[&Candidate], options: &ReadOptions, path: &Path) -> Result<usize> {
    let listed = || {
        let names: Vec<_> =
            found.iter().take(20).map(|c| format!("{} {:?}", c.path, c.shape)).collect();
        names.join(", ")
    };
    if let Some(wanted) = &options.array {
        let wanted = wanted.trim_start_matches('/');
        return found.iter().position(|c| c.path.trim_start_matches('/') == wanted).ok_or_else(
            || {
                Error::data(
                    format!("no dataset `{wanted}` in it"),
                    path,
                    format!("there are {}", listed()),
                )
            },
        );
    }
    let mut captures = found.iter().enumerate().filter(|(_, c)| c.shape.len() >= 3);
    match (captures.next(), captures.next()) {
        (Some((at, _)), None) => Ok(at),
        (None, _) => Err(Error::data(
            if found.is_empty() {
                "no dataset of numbers in it".to_owned()
            } else {
                format!("no dataset of frames in it; there are {}", listed())
            },
            path,
            "a capture has the axes frames, height, width",
        )),
        (Some(_), Some(_)) => Err(Error::data(
            format!("several datasets could be the capture: {}", listed()),
            path,
            "name one with `array`",
        )),
    }
}

/// Returns the sample type, if it could be a count. Booleans are stored as an enumeration of bytes.
fn sample(datatype: &Datatype) -> Option<Sample> {
    let big = |order: &DatatypeByteOrder| match order {
        DatatypeByteOrder::LittleEndian => Some(false),
        DatatypeByteOrder::BigEndian => Some(true),
        DatatypeByteOrder::Vax => None,
    };
    match datatype {
        Datatype::FixedPoint { size, byte_order, layout } => {
            let (big_endian, signed) = (big(byte_order)?, layout.signed);
            match (size, signed) {
                (1, false) => Some(Sample::U8),
                (2, false) => Some(Sample::U16 { big_endian }),
                (1 | 2 | 4 | 8, _) => {
                    Some(Sample::Integer { bytes: *size as u8, signed, big_endian })
                }
                _ => None,
            }
        }
        Datatype::FloatingPoint { size: 4, byte_order, .. } => {
            Some(Sample::F32 { big_endian: big(byte_order)? })
        }
        Datatype::FloatingPoint { size: 8, byte_order, .. } => {
            Some(Sample::F64 { big_endian: big(byte_order)? })
        }
        Datatype::Enumeration { base_type, .. } => match sample(base_type)? {
            Sample::U8 | Sample::Integer { bytes: 1, .. } => Some(Sample::Bool),
            _ => None,
        },
        _ => None,
    }
}
