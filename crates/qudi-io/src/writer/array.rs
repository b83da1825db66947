//! A `.npy` array written item by item along its first axis, of any length.

use qudi_core::Result;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::npy::write_header;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

/// A growing `.npy` file.
#[derive(Debug)]
pub struct ArrayWriter {
    file: PendingFile,
    descr: &'static str,
    shape: Vec<usize>,
}

impl ArrayWriter {
    /// Starts an array of items of shape `item`, samples of NumPy type `descr`.
    ///
    /// # Errors
    /// [`qudi_core::Error`] if the name is taken or the folder cannot be written.
    pub fn create(
        path: &Path,
        overwrite: Overwrite,
        descr: &'static str,
        item: &[usize],
    ) -> Result<Self> {
        let mut file = PendingFile::create(path, overwrite)?;
        let mut shape = vec![0];
        shape.extend_from_slice(item);
        write_header(&mut file, descr, &shape).map_err(|e| file.fault(e))?;
        Ok(Self { file, descr, shape })
    }

    /// Adds one item, given as little-endian bytes.
    ///
    /// # Errors
    /// [`qudi_core::Error::Io`] if the disk is full.
    pub fn push(&mut self, bytes: &[u8]) -> Result<()> {
        self.shape[0] += 1;
        self.file.write_all(bytes).map_err(|e| self.file.fault(e))
    }

    /// Adds one item of f32 samples.
    ///
    /// # Errors
    /// [`qudi_core::Error::Io`] if the disk is full.
    pub fn push_f32(&mut self, values: impl Iterator<Item = f32>) -> Result<()> {
        let bytes: Vec<u8> = values.flat_map(f32::to_le_bytes).collect();
        self.push(&bytes)
    }

    /// Writes the true length into the header and gives the file its name.
    ///
    /// # Errors
    /// [`qudi_core::Error::Io`] if the disk is full.
    pub fn finish(mut self) -> Result<()> {
        let mut header = Vec::new();
        let rewritten = write_header(&mut header, self.descr, &self.shape)
            .and_then(|()| self.file.flushed())
            .and_then(|file| {
                file.seek(SeekFrom::Start(0))?;
                file.write_all(&header)
            });
        rewritten.map_err(|e| self.file.fault(e))?;
        self.file.finish()
    }
}
