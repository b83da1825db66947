//! Counts as a multi-page TIFF, as ImageJ opens it.

use crate::error::{Result, SimError};
use crate::frame::Size;
use crate::output::{Overwrite, PendingFile};
use std::cell::RefCell;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use tiff::encoder::{TiffEncoder, colortype};

/// Classic TIFF ends at 4 GiB; larger bursts need BigTIFF.
const CLASSIC_LIMIT: u64 = 4_000_000_000;

/// The encoder keeps its file for good; sharing it gives it back.
struct Shared(Rc<RefCell<PendingFile>>);

impl Write for Shared {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.borrow_mut().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.borrow_mut().flush()
    }
}

impl Seek for Shared {
    fn seek(&mut self, position: SeekFrom) -> std::io::Result<u64> {
        self.0.borrow_mut().seek(position)
    }
}

pub(super) struct TiffStack {
    encoder: TiffEncoder<Shared>,
    file: Rc<RefCell<PendingFile>>,
    path: PathBuf,
    size: Size,
    deep: bool,
    bytes: u64,
}

impl TiffStack {
    pub(super) fn create(
        path: &Path,
        size: Size,
        max_count: u16,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let file = Rc::new(RefCell::new(PendingFile::create(path, overwrite)?));
        let encoder = TiffEncoder::new(Shared(Rc::clone(&file))).map_err(|e| fault(path, e))?;
        Ok(Self { encoder, file, path: path.to_owned(), size, deep: max_count > 255, bytes: 0 })
    }

    pub(super) fn push(&mut self, counts: &[u16]) -> Result<()> {
        let (width, height) = (self.size.width as u32, self.size.height as u32);
        self.bytes += (counts.len() * if self.deep { 2 } else { 1 } + 512) as u64;
        if self.bytes > CLASSIC_LIMIT {
            return Err(SimError::data(
                "the burst outgrows the 4 GiB of a TIFF file",
                &self.path,
                "write it as .npy, or in parts with --frames",
            ));
        }
        let written = if self.deep {
            self.encoder.write_image::<colortype::Gray16>(width, height, counts)
        } else {
            let bytes: Vec<u8> = counts.iter().map(|&c| c as u8).collect();
            self.encoder.write_image::<colortype::Gray8>(width, height, &bytes)
        };
        written.map_err(|e| fault(&self.path, e))
    }

    pub(super) fn finish(self) -> Result<()> {
        drop(self.encoder);
        let file = Rc::into_inner(self.file).expect("the encoder held the only other share");
        file.into_inner().finish()
    }
}

fn fault(path: &Path, e: tiff::TiffError) -> SimError {
    match e {
        tiff::TiffError::IoError(e) => SimError::io("write", path, e),
        other => SimError::io("write", path, std::io::Error::other(other)),
    }
}
