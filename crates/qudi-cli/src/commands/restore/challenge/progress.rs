//! Pictures that are finished, next to the archive until it is: a killed run goes on after them.

use super::cube::Cube;
use crate::error::{CliError, Result};
use image::{ImageReader, RgbImage};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Frame, Size};
use qudi_io::restore::{FolderRun, FrameFolder, Inputs, MANIFEST, Share};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// File of the methods that made the finished pictures.
const METHODS: &str = "methods.json";

/// Factor from 8-bit samples to the 16-bit ones of the folder, which keep them exactly.
const DEPTH: u16 = 257;

/// A folder of finished pictures.
pub(super) struct Progress {
    folder: FrameFolder,
    path: PathBuf,
    count: u64,
    /// Methods that made the pictures.
    pub(super) methods: BTreeSet<String>,
}

impl Progress {
    /// Opens the folder next to `archive` for the pictures of `cubes`, new or of a run with equal settings
    /// on the same set.
    ///
    /// # Errors
    /// [`CliError`] if there is another run's, or it cannot be made.
    pub(super) fn open(
        archive: &Path,
        set: &Path,
        cubes: &[Cube],
        settings: Value,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let mut name = archive.file_name().unwrap_or_default().to_owned();
        name.push(".unfinished");
        let (path, count) = (archive.with_file_name(name), cubes.len() as u64);
        let mut inputs = Inputs::default();
        // Scene by scene: the archive may lie in the set.
        let mut scenes: Vec<_> =
            cubes.iter().filter_map(|cube| cube.name.split('/').next()).collect();
        scenes.dedup();
        for scene in scenes {
            inputs.add(scene, &set.join(scene))?;
        }
        let run = FolderRun { settings, inputs, share: Share::Whole, frames: Some(count) };
        let folder = FrameFolder::open(&path, cubes[0].size(), run, overwrite)?;
        let methods = path.join(METHODS);
        let methods = if folder.finished(0..count) > 0 && methods.is_file() {
            let text = read_limited(&methods, RECORD_BYTES, "read the methods")?;
            serde_json::from_slice(&text).unwrap_or_default()
        } else {
            BTreeSet::new()
        };
        Ok(Self { folder, path, count, methods })
    }

    /// Returns the number of finished pictures.
    pub(super) fn finished(&self) -> usize {
        self.folder.finished(0..self.count) as usize
    }

    /// Keeps the picture of a cube, made by `method`; by none if it is dark.
    ///
    /// # Errors
    /// [`CliError`] if the disk is full.
    pub(super) fn push(
        &mut self,
        number: usize,
        picture: &RgbImage,
        method: Option<String>,
    ) -> Result<()> {
        if method.is_some_and(|method| self.methods.insert(method)) {
            let text = serde_json::to_string(&self.methods).unwrap_or_default();
            let path = self.path.join(METHODS);
            PendingFile::write_whole(&path, text.as_bytes(), Overwrite::Yes)?;
        }
        let size = Size { height: picture.height() as usize, width: picture.width() as usize };
        let planes: [Frame; 3] = std::array::from_fn(|colour| {
            let values = picture.as_raw().iter().skip(colour).step_by(3);
            Frame { size, data: values.map(|&value| f32::from(value) / 255.0).collect() }
        });
        Ok(self.folder.push_colour(number as u64, &planes)?)
    }

    /// Reads the finished picture of a cube.
    ///
    /// # Errors
    /// [`CliError`] if it is damaged or has another size.
    pub(super) fn read(&self, number: usize, size: Size) -> Result<RgbImage> {
        let path = self.folder.file(number as u64);
        let fault = |what: String| {
            let help = "start over with --force";
            CliError::new(format!("cannot read a finished picture: {what}"), path.display(), help)
        };
        let reader = ImageReader::open(&path).map_err(|e| fault(e.to_string()))?;
        let image = reader.decode().map_err(|e| fault(e.to_string()))?.into_rgb16();
        if (image.height() as usize, image.width() as usize) != (size.height, size.width) {
            return Err(fault(format!(
                "{} x {} for a cube of {size}",
                image.height(),
                image.width()
            )));
        }
        let samples = image.as_raw().iter().map(|&sample| (sample / DEPTH) as u8).collect();
        RgbImage::from_raw(image.width(), image.height(), samples)
            .ok_or_else(|| fault("samples are missing".to_owned()))
    }

    /// Removes the folder, whose pictures are in the archive; files of others stay.
    pub(super) fn remove(self) {
        let Self { folder, path, count, .. } = self;
        let files = (0..count).map(|number| folder.file(number));
        let files: Vec<_> = files.chain([MANIFEST, METHODS].map(|name| path.join(name))).collect();
        drop(folder);
        for file in files {
            let _ = std::fs::remove_file(file);
        }
        let _ = std::fs::remove_dir(path);
    }
}
