//! A folder of image files, in the order of the numbers in their names.

use super::FrameReader;
use super::image_file::{EXTENSIONS, is_image, read_still};
use qudi_core::Transfer;
use qudi_core::natural_order::natural_order;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::path::{Path, PathBuf};

pub(super) struct ImageFolder {
    files: std::vec::IntoIter<PathBuf>,
    total: u64,
    first: Option<Frame>,
    size: Size,
    transfer: Transfer,
}

impl ImageFolder {
    pub(super) fn open(folder: &Path, transfer: Transfer) -> Result<Self> {
        let read = |e| Error::io("list the folder", folder, e);
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(read)? {
            let path = entry.map_err(read)?.path();
            // macOS adds `._a.png` for every `a.png` on other file systems: attributes, no image.
            if is_image(&path) && !file_name(&path).starts_with("._") {
                files.push(path);
            }
        }
        files.sort_by(|a, b| natural_order(&file_name(a), &file_name(b)));
        let Some(name) = files.first() else {
            return Err(Error::data(
                "the folder holds no images",
                folder,
                format!("put frames into it as {}", EXTENSIONS.join(", ")),
            ));
        };
        let first = read_still(name, transfer)?;
        let total = files.len() as u64;
        let size = first.size;
        let mut files = files.into_iter();
        files.next();
        Ok(Self { files, total, size, first: Some(first), transfer })
    }
}

impl FrameReader for ImageFolder {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        Some(self.total)
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        let Some(path) = self.files.next() else { return Ok(None) };
        let frame = read_still(&path, self.transfer)?;
        if frame.size != self.size {
            return Err(Error::data(
                format!("an image of {} among images of {}", frame.size, self.size),
                &path,
                "frames of one clip have one size: resize it, or move it to another folder",
            ));
        }
        Ok(Some(frame))
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skips_attribute_files_of_macos() {
        let folder = tempfile::tempdir().unwrap();
        let image = image::GrayImage::from_pixel(3, 2, image::Luma([51]));
        image.save(folder.path().join("a.png")).unwrap();
        std::fs::write(folder.path().join("._a.png"), b"\0\x05\x16\x07").unwrap();
        let mut clip = ImageFolder::open(folder.path(), Transfer::AsIs).unwrap();
        assert_eq!((clip.frames(), clip.size()), (Some(1), Size { height: 2, width: 3 }));
        assert_eq!(clip.next().unwrap().unwrap().data, [0.2; 6]);
    }
}
