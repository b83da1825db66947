//! Storage of arrays in an unnamed file, where frames cannot be read in order.

use super::{Array, Place};
use qudi_core::limits::DEFLATE_RATIO;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::{Read, Write};

/// Bytes fetched at once.
const PIECE_BYTES: u64 = 1 << 25;

impl Array {
    /// Stores a compressed or chunked array as it is in memory, so that any part of it can be read.
    pub(super) fn spool(&mut self) -> Result<()> {
        let bytes = self.shape.iter().try_fold(self.sample.bytes() as u64, |bytes, &extent| {
            bytes.checked_mul(extent as u64)
        });
        let bytes = bytes.unwrap_or(u64::MAX);
        let io = |e| Error::io("store the frames of", &self.path, e);
        let file = match &mut self.place {
            Place::File { .. } | Place::Spool { .. } => return Ok(()),
            Place::Pipe(_) => {
                return Err(self.fault(
                    "the frame axis of a piped array is not its first",
                    "store it in a file: there its frames are gathered",
                ));
            }
            Place::Stream(opener) => {
                let mut file = tempfile::tempfile().map_err(io)?;
                let mut stream = opener()?;
                let copied = std::io::copy(&mut stream.by_ref().take(bytes), &mut file)
                    // Decoders compare checksums at their end.
                    .and_then(|n| std::io::copy(&mut stream, &mut std::io::sink()).map(|_| n));
                match copied {
                    Ok(n) if n == bytes => file,
                    Ok(n) => {
                        return Err(self.fault(
                            format!("the compressed data are {n} bytes instead of {bytes}"),
                            "the file is truncated or damaged: copy or export it again",
                        ));
                    }
                    Err(e) => {
                        return Err(self.fault(
                            format!("the compressed data are damaged: {e}"),
                            "copy or export the file again",
                        ));
                    }
                }
            }
            Place::Fetch { fetch, group } => {
                let stored = std::fs::metadata(&self.path).map_err(io)?.len();
                if bytes > stored.saturating_mul(DEFLATE_RATIO) {
                    return Err(self.fault(
                        format!("an array of shape {:?} in a file of {stored} bytes", self.shape),
                        "it promises more than they can hold: export the file again",
                    ));
                }
                let mut file = tempfile::tempfile().map_err(io)?;
                let rows = self.shape.first().copied().unwrap_or(0) as u64;
                let fit = (PIECE_BYTES / (bytes / rows.max(1)).max(1)).max(1);
                let at_once = if *group <= fit { fit / *group * *group } else { fit };
                let mut first = 0;
                while first < rows {
                    let count = at_once.min(rows - first);
                    let piece = fetch(first, count)?;
                    file.write_all(&piece)
                        .map_err(|e| Error::io("store the frames of", &self.path, e))?;
                    first += count;
                }
                file
            }
        };
        let available = length(&file, &self.path)?;
        self.place = Place::Spool { file, start: 0, available };
        Ok(())
    }
}

fn length(file: &File, path: &std::path::Path) -> Result<u64> {
    Ok(file.metadata().map_err(|e| Error::io("store the frames of", path, e))?.len())
}
