//! visionsim datasets: `transforms.json` next to `frames.npy` or a list of images.

use super::array::{Hints, Stored};
use super::images::open_files;
use super::npy::open_array;
use super::{Format, Recognition};
use crate::description::{
    BitOrder, CaptureInfo, Certainty, PackAxis, Packing, ReadOptions, refuse_others,
};
use crate::frames::CountFrames;
use crate::frames::reordered::reordered;
use crate::recognition::Probe;
use qudi_core::Size;
use qudi_core::limits::INDEX_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use serde::Deserialize;
use std::path::{Component, Path, PathBuf};

pub(crate) const FORMAT: Format = Format {
    name: "visionsim",
    title: "visionsim dataset",
    options: super::ARRAY_OPTIONS,
    probe: |probe| {
        let found = document(&probe.path).is_file();
        Ok(found.then(|| Recognition::new(Certainty::Certain, &["transforms.json"])))
    },
    open,
};

#[derive(Deserialize)]
struct Transforms {
    w: Option<usize>,
    h: Option<usize>,
    c: Option<usize>,
    fps: Option<f64>,
    file_path: Option<String>,
    #[serde(default)]
    bitpack: Option<bool>,
    bitpack_dim: Option<u32>,
    #[serde(default)]
    frames: Vec<Pose>,
}

#[derive(Deserialize)]
struct Pose {
    file_path: Option<String>,
}

fn document(path: &Path) -> PathBuf {
    let itself = path.file_name().is_some_and(|name| name == "transforms.json");
    if itself { path.to_owned() } else { path.join("transforms.json") }
}

/// Returns the files that the data set at `path` lists; none if it is no data set.
pub(super) fn files_of(path: &Path) -> Vec<PathBuf> {
    let path = document(path);
    let bytes = read_limited(&path, INDEX_BYTES, "read the list of frames").unwrap_or_default();
    let Ok(transforms) = serde_json::from_slice::<Transforms>(&bytes) else { return Vec::new() };
    let folder = path.parent().unwrap_or(Path::new("."));
    let frames = transforms.frames.iter().filter_map(|pose| pose.file_path.as_deref());
    let names = transforms.file_path.as_deref().into_iter().chain(frames);
    names.filter_map(|name| inside(folder, name)).collect()
}

fn open(
    probe: &Probe,
    options: &ReadOptions,
    info: &mut CaptureInfo,
) -> Result<Box<dyn CountFrames>> {
    let path = document(&probe.path);
    let fault = |what: String| {
        Error::data(what, &path, "write the data set again with visionsim, or name the .npy itself")
    };
    let bytes = read_limited(&path, INDEX_BYTES, "read the list of frames")?;
    let transforms: Transforms = serde_json::from_slice(&bytes)
        .map_err(|e| fault(format!("not visionsim's transforms.json: {e}")))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    info.fps = transforms.fps;
    if transforms.c.is_some_and(|c| c > 1) && options.channel.is_none() {
        return Err(Error::data(
            format!("a colour capture of {} channels", transforms.c.unwrap_or(0)),
            &path,
            "read one channel as gray with `channel 0`, 1 or 2",
        ));
    }
    if let Some(name) = &transforms.file_path {
        let data =
            inside(folder, name).ok_or_else(|| fault(format!("its data lie at `{name}`")))?;
        return open_array(&data)?.open(options, &transforms.hints(&path)?, info);
    }
    refuse_others(options, super::PICTURE_OPTIONS, "a data set of images")?;
    let files: Option<Vec<PathBuf>> =
        transforms.frames.iter().map(|pose| inside(folder, pose.file_path.as_deref()?)).collect();
    let files = files.ok_or_else(|| fault("frames without file_path".to_owned()))?;
    reordered(open_files(files, &path, false, options, info)?, options.axes, &path)
}

/// Returns the path of `name` inside the data set.
fn inside(folder: &Path, name: &str) -> Option<PathBuf> {
    let ordinary = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    Path::new(name).components().all(ordinary).then(|| folder.join(name))
}

impl Transforms {
    fn hints(&self, path: &Path) -> Result<Hints> {
        let axis = match (self.bitpack, self.bitpack_dim) {
            (Some(false), _) => PackAxis::None,
            (None, None) => return Ok(Hints::default()),
            (_, None | Some(2)) => PackAxis::Width,
            (_, Some(1)) => PackAxis::Height,
            (_, Some(dim)) => {
                return Err(Error::data(
                    format!("bits packed along axis {dim}"),
                    path,
                    "frames are packed along axis 1 (height) or 2 (width)",
                ));
            }
        };
        let size = match (self.h, self.w) {
            (Some(h), Some(w)) => Some(Size::new(h, w, &path.display().to_string())?),
            _ => None,
        };
        let packed = axis != PackAxis::None;
        let packing = packed.then_some(Packing { axis, order: BitOrder::Msb });
        Ok(Hints { stored: Stored::from(packing), size, recorded: None })
    }
}
