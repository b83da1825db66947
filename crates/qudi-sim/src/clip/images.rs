//! A folder of image files, in the order of the numbers in their names; a TIFF may hold several frames.

use super::FrameReader;
use super::image_file::{AssumedWhite, EXTENSIONS, has_image_name, is_image, read_scaled};
use super::tiff_pages::{TiffPages, is_tiff};
use qudi_core::Transfer;
use qudi_core::natural_order::natural_order;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::path::{Path, PathBuf};

pub(super) struct ImageFolder {
    files: std::vec::IntoIter<PathBuf>,
    /// The file that is being read, if it has several pages.
    pages: Option<TiffPages>,
    total: u64,
    first: Option<Frame>,
    size: Size,
    transfer: Transfer,
    white: Option<f32>,
    assumed_white: AssumedWhite,
}

impl ImageFolder {
    pub(super) fn open(folder: &Path, transfer: Transfer, white: Option<f32>) -> Result<Self> {
        let read = |e| Error::io("list the folder", folder, e);
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(read)? {
            let path = entry.map_err(read)?.path();
            // macOS adds `._a.png` for every `a.png` on other file systems: attributes, no image.
            if file_name(&path).starts_with("._") {
                continue;
            }
            if is_image(&path) {
                files.push(path);
            } else if has_image_name(&path) && !path.is_dir() {
                let help = "remove it, or put the frame in its place";
                return Err(Error::data("a broken link, a pipe or a device", &path, help));
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
        let (mut first, mut assumed_white) = (None, None);
        let mut pages = several_pages(name, transfer, white)?;
        let size = if let Some(pages) = &mut pages {
            assumed_white = pages.assumed_white()?;
            pages.size()
        } else {
            let (frame, assumed) = read_scaled(name, transfer, white)?;
            assumed_white = assumed.or(assumed_white);
            first.insert(frame).size
        };
        let mut total = 0;
        for file in &files {
            total += several_pages(file, transfer, white)?.map_or(1, |pages| pages.pages());
        }
        let mut files = files.into_iter();
        files.next();
        Ok(Self { files, pages, total, first, size, transfer, white, assumed_white })
    }
}

/// Opens a TIFF if it has several pages.
fn several_pages(path: &Path, transfer: Transfer, white: Option<f32>) -> Result<Option<TiffPages>> {
    let pages = is_tiff(path).then(|| TiffPages::open(path, transfer, white)).transpose()?;
    Ok(pages.filter(|pages| pages.pages() > 1))
}

impl FrameReader for ImageFolder {
    fn size(&self) -> Size {
        self.size
    }

    fn frames(&self) -> Option<u64> {
        Some(self.total)
    }

    fn assumed_white(&mut self) -> Result<AssumedWhite> {
        Ok(self.assumed_white)
    }

    fn next(&mut self) -> Result<Option<Frame>> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        if let Some(frame) = self.pages.as_mut().map(FrameReader::next).transpose()?.flatten() {
            return Ok(Some(frame));
        }
        let Some(path) = self.files.next() else { return Ok(None) };
        self.pages = several_pages(&path, self.transfer, self.white)?;
        let frame = match &mut self.pages {
            None => Some(read_scaled(&path, self.transfer, self.white)?.0),
            Some(pages) => pages.next()?,
        };
        let Some(frame) = frame else { return Ok(None) };
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

    #[cfg(unix)]
    #[test]
    fn names_broken_links() {
        let folder = tempfile::tempdir().unwrap();
        let image = image::GrayImage::from_pixel(3, 2, image::Luma([51]));
        image.save(folder.path().join("a.png")).unwrap();
        std::os::unix::fs::symlink("nowhere", folder.path().join("b.png")).unwrap();
        let error = ImageFolder::open(folder.path(), Transfer::AsIs, None).err().unwrap();
        assert!(error.to_string().contains("broken link"), "{error}");
    }

    #[test]
    fn skips_attribute_files_of_macos() {
        let folder = tempfile::tempdir().unwrap();
        let image = image::GrayImage::from_pixel(3, 2, image::Luma([51]));
        image.save(folder.path().join("a.png")).unwrap();
        std::fs::write(folder.path().join("._a.png"), b"\0\x05\x16\x07").unwrap();
        let mut clip = ImageFolder::open(folder.path(), Transfer::AsIs, None).unwrap();
        assert_eq!((clip.frames(), clip.size()), (Some(1), Size { height: 2, width: 3 }));
        assert_eq!(clip.next().unwrap().unwrap().data, [0.2; 6]);
    }
}
