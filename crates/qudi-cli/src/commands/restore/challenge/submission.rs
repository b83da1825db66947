//! The archive that the Single Photon Challenge takes: `SCENE/FRAME.png` for every cube, and nothing else.

use crate::error::{CliError, Result};
use image::{ImageFormat, RgbImage};
use qudi_core::Error;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Bytes of an archive that the challenge's site takes.
pub(super) const MAX_BYTES: u64 = 300 << 20;

/// An archive that is being written.
pub(super) struct Submission {
    zip: ZipWriter<PendingFile>,
    path: PathBuf,
}

impl Submission {
    /// Creates an archive, which has its name when it is finished.
    ///
    /// # Errors
    /// [`CliError`] if the name does not end in .zip, or the file cannot be created.
    pub(super) fn create(path: &Path, overwrite: Overwrite) -> Result<Self> {
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip")) {
            return Err(CliError::new(
                "the challenge takes a zip archive",
                path.display(),
                "name it, for example, submission.zip",
            ));
        }
        let file = PendingFile::create(path, overwrite)?;
        Ok(Self { zip: ZipWriter::new(file), path: path.to_owned() })
    }

    /// Adds the picture of a cube.
    ///
    /// # Errors
    /// [`CliError`] if it cannot be written.
    pub(super) fn add(&mut self, name: &str, picture: &RgbImage) -> Result<()> {
        let mut png = Cursor::new(Vec::new());
        picture.write_to(&mut png, ImageFormat::Png).map_err(|e| {
            CliError::new(format!("cannot encode {name}: {e}"), self.path.display(), "report this")
        })?;
        // A PNG is compressed already.
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(zip::DateTime::default());
        let path = &self.path;
        self.zip.start_file(format!("{name}.png"), options).map_err(|e| failed(path, e))?;
        let io = |e| Error::io("write the archive", path, e);
        Ok(self.zip.write_all(png.get_ref()).map_err(io)?)
    }

    /// Finishes the archive under its name, and returns its number of bytes.
    ///
    /// # Errors
    /// [`CliError`] if it cannot be written.
    pub(super) fn finish(self) -> Result<u64> {
        let Self { zip, path } = self;
        zip.finish().map_err(|e| failed(&path, e))?.finish()?;
        let about =
            std::fs::metadata(&path).map_err(|e| Error::io("find the archive", &path, e))?;
        Ok(about.len())
    }
}

fn failed(path: &Path, error: zip::result::ZipError) -> CliError {
    CliError::new(format!("cannot write the archive: {error}"), path.display(), "free some space")
}
