//! A multi-page TIFF, as ImageJ opens it: gray counts of 8 or 16 bits, or gray or colour images of 16 bits or
//! float.

use qudi_core::Size;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use std::cell::RefCell;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use tiff::encoder::colortype::{self, ColorType};
use tiff::encoder::{TiffEncoder, TiffValue};

/// Largest stack in bytes of a classic TIFF, which ends at 4 GiB; larger stacks need BigTIFF.
const CLASSIC_LIMIT: u64 = 4_000_000_000;

/// Largest number of bytes of a page besides its samples.
const MAX_DIRECTORY_BYTES: usize = 512;

/// A shared file: the encoder never returns the one that it is given.
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

/// Samples of a stack of images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TiffSamples {
    /// 16 bits; 65535 is 1, and values outside 0 to 1 are clipped.
    U16,
    /// 32-bit float; values as they are.
    F32,
}

/// A growing stack. Every page keeps the samples that it is given in.
pub(crate) struct TiffStack {
    encoder: TiffEncoder<Shared>,
    file: Rc<RefCell<PendingFile>>,
    path: PathBuf,
    size: Size,
    bytes: u64,
}

impl TiffStack {
    pub(crate) fn create(path: &Path, size: Size, overwrite: Overwrite) -> Result<Self> {
        let file = Rc::new(RefCell::new(PendingFile::create(path, overwrite)?));
        let encoder = TiffEncoder::new(Shared(Rc::clone(&file))).map_err(|e| fault(path, e))?;
        Ok(Self { encoder, file, path: path.to_owned(), size, bytes: 0 })
    }

    pub(crate) fn push_u8(&mut self, samples: &[u8]) -> Result<()> {
        self.push::<colortype::Gray8>(samples)
    }

    pub(crate) fn push_u16(&mut self, samples: &[u16]) -> Result<()> {
        self.push::<colortype::Gray16>(samples)
    }

    pub(crate) fn push_f32(&mut self, samples: &[f32]) -> Result<()> {
        self.push::<colortype::Gray32Float>(samples)
    }

    pub(crate) fn push_rgb16(&mut self, samples: &[u16]) -> Result<()> {
        self.push::<colortype::RGB16>(samples)
    }

    pub(crate) fn push_rgb_f32(&mut self, samples: &[f32]) -> Result<()> {
        self.push::<colortype::RGB32Float>(samples)
    }

    fn push<C: ColorType>(&mut self, samples: &[C::Inner]) -> Result<()>
    where
        [C::Inner]: TiffValue,
    {
        self.bytes += (size_of_val(samples) + MAX_DIRECTORY_BYTES) as u64;
        if self.bytes > CLASSIC_LIMIT {
            return Err(Error::data(
                "the stack outgrows the 4 GiB of a TIFF file",
                &self.path,
                "write it as .npy, or fewer frames at a time",
            ));
        }
        let (width, height) = (self.size.width as u32, self.size.height as u32);
        self.encoder.write_image::<C>(width, height, samples).map_err(|e| fault(&self.path, e))
    }

    pub(crate) fn finish(self) -> Result<()> {
        drop(self.encoder);
        let file = Rc::into_inner(self.file).expect("the encoder held the only other share");
        file.into_inner().finish()
    }
}

fn fault(path: &Path, e: tiff::TiffError) -> Error {
    match e {
        tiff::TiffError::IoError(e) => Error::io("write", path, e),
        other => Error::io("write", path, std::io::Error::other(other)),
    }
}
