//! CRC-32 checks of stored data while it is read.

use crc32fast::Hasher;
use std::io::{Error, ErrorKind, Read, Result};

/// A reader that fails at its end if the CRC-32 of all bytes is not the expected one.
pub(crate) struct CrcReader<R> {
    inner: R,
    hasher: Hasher,
    expected: u32,
}

impl<R: Read> CrcReader<R> {
    pub(crate) fn new(inner: R, expected: u32) -> Self {
        Self { inner, hasher: Hasher::new(), expected }
    }
}

impl<R: Read> Read for CrcReader<R> {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize> {
        let n = self.inner.read(bytes)?;
        self.hasher.update(&bytes[..n]);
        if n == 0 && !bytes.is_empty() {
            let found = self.hasher.clone().finalize();
            if found != self.expected {
                return Err(mismatch(found, self.expected));
            }
        }
        Ok(n)
    }
}

/// Returns the error of data whose CRC-32 is `found` instead of `expected`.
pub(crate) fn mismatch(found: u32, expected: u32) -> Error {
    let text = format!("their CRC-32 is {found:08x}, the archive notes {expected:08x}");
    Error::new(ErrorKind::InvalidData, text)
}
