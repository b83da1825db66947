//! Counts as a folder of gray PNG files: `frame_000000.png`, ...

use crate::writer::{frame_name, is_frame_below};
use image::{ImageBuffer, Luma};
use qudi_core::Size;
use qudi_core::atomic_file::{Overwrite, OwnFolder, PendingFolder};
use qudi_core::{Error, Result};
use std::path::Path;

pub(crate) struct PngFolder {
    folder: PendingFolder,
    size: Size,
    deep: bool,
    frames: u64,
}

impl PngFolder {
    /// Name of the record, which also marks the folder as ours.
    pub(crate) const RECORD: &str = "burst.json";

    pub(crate) fn create(
        path: &Path,
        size: Size,
        max_count: u16,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let own = OwnFolder {
            manifest: Self::RECORD,
            is_named: |record, name| {
                let frames = record["burst"]["frames"].as_u64();
                frames.is_some_and(|frames| is_frame_below(name, frames))
            },
        };
        let folder = PendingFolder::create(path, overwrite, own)?;
        Ok(Self { folder, size, deep: max_count > 255, frames: 0 })
    }

    pub(crate) fn push(&mut self, counts: &[u16]) -> Result<()> {
        let name = frame_name(self.frames);
        self.frames += 1;
        let (width, height) = (self.size.width as u32, self.size.height as u32);
        let file = self.folder.file(&name);
        let saved = if self.deep {
            let image = ImageBuffer::<Luma<u16>, _>::from_raw(width, height, counts);
            image.expect("the camera's size").save(&file)
        } else {
            let bytes: Vec<u8> = counts.iter().map(|&c| c as u8).collect();
            let image = ImageBuffer::<Luma<u8>, _>::from_raw(width, height, bytes);
            image.expect("the camera's size").save(&file)
        };
        saved.map_err(|e| {
            Error::io("write a frame into", self.folder.path(), std::io::Error::other(e))
        })
    }

    pub(crate) fn finish(self, record: &[u8]) -> Result<()> {
        self.folder.finish(record)
    }
}
