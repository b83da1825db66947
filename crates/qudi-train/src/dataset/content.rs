//! Search for the clips and stills that a source names.

use super::config::SourceKind;
use super::pack_index::PackedSource;
use qudi_core::natural_order::natural_order;
use qudi_core::{Error, Result};
use qudi_sim::clip::is_image;
use std::path::{Path, PathBuf};

/// One clip or still to read: its name in the pack, where it is, and how large.
#[derive(Debug)]
pub(super) struct Content {
    pub(super) name: String,
    pub(super) path: PathBuf,
}

impl Content {
    /// Returns the bytes of the file, or of all files in the folder.
    pub(super) fn bytes(&self) -> Result<u64> {
        let fault = |e| Error::io("read the size of the source", &self.path, e);
        let about = std::fs::metadata(&self.path).map_err(fault)?;
        if !about.is_dir() {
            return Ok(about.len());
        }
        let mut bytes = 0;
        for file in std::fs::read_dir(&self.path).map_err(fault)? {
            bytes += file.and_then(|file| file.metadata()).map_err(fault)?.len();
        }
        Ok(bytes)
    }
}

/// Largest depth of folders that are searched.
const MAX_DEPTH: usize = 4;

/// Extensions of files that are skipped in folders of videos.
const OTHER_EXTENSIONS: &[&str] = &["txt", "md", "json", "csv", "zip", "npy", "toml", "html"];

/// Returns everything that a source names, in the order of names, below `data`.
pub(super) fn contents(source: &PackedSource, data: &Path) -> Result<Vec<Content>> {
    let mut list = Vec::new();
    for from in &source.from {
        let path = data.join(from);
        let about = std::fs::metadata(&path)
            .map_err(|e| Error::io(format!("find the source `{}`", source.name), &path, e))?;
        if about.is_dir() {
            gather(source.kind, &path, MAX_DEPTH, &mut list)?;
        } else {
            list.push(path);
        }
    }
    if list.is_empty() {
        return Err(Error::data(
            format!("source `{}` holds nothing", source.name),
            data,
            "name videos, folders of frames, or images",
        ));
    }
    let names = list.iter().map(|path| {
        let relative = path.strip_prefix(data).unwrap_or(path).with_extension("");
        let name = relative.to_string_lossy();
        name.chars().map(|c| if c.is_alphanumeric() || c == '.' { c } else { '-' }).collect()
    });
    let names: Vec<String> = names.collect();
    Ok(names.into_iter().zip(list).map(|(name, path)| Content { name, path }).collect())
}

/// Returns the content of a folder: for clips a folder of images is one clip and other files are videos.
fn gather(kind: SourceKind, folder: &Path, depth: usize, list: &mut Vec<PathBuf>) -> Result<()> {
    let read = |e| Error::io("list the folder", folder, e);
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(read)? {
        let path = entry.map_err(read)?.path();
        if !path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.')) {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        let help = "put frames or videos into it, or remove it";
        return Err(Error::data("an empty folder among the sources", folder, help));
    }
    paths.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    if kind == SourceKind::Clips && paths.iter().any(|path| is_image(path)) {
        list.push(folder.to_owned());
        return Ok(());
    }
    for path in paths {
        if path.is_dir() {
            if depth > 0 {
                gather(kind, &path, depth - 1, list)?;
            }
        } else if kind == SourceKind::Stills {
            // Pipes and broken links are refused by name when they are read.
            if is_image(&path) || !path.is_file() {
                list.push(path);
            }
        } else {
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            if !extension.is_empty() && !OTHER_EXTENSIONS.contains(&extension.as_str()) {
                list.push(path);
            }
        }
    }
    Ok(())
}
