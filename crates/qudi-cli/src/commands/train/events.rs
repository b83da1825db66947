//! Metrics as an event file, which TensorBoard opens: records with checksums around `Event` messages of
//! TensorFlow's protocol buffers (event.proto, summary.proto; record_writer.cc for the frame).

use crate::error::{CliError, Result};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// An open event file.
#[derive(Debug)]
pub(crate) struct EventFile {
    file: File,
    path: PathBuf,
}

impl EventFile {
    /// Starts a new one in a run's folder; viewers join all that lie there.
    pub(crate) fn create(folder: &Path) -> Result<Self> {
        let name = format!("events.out.tfevents.{:010}.qudi", now() as u64);
        let path = folder.join(name);
        let file = File::create(&path).map_err(|e| failed(&path, &e))?;
        let mut events = Self { file, path };
        events.write(|event| field_bytes(event, 3, b"brain.Event:2"))?;
        Ok(events)
    }

    /// Writes scalars of one step.
    pub(crate) fn scalars(&mut self, step: u64, scalars: &[(String, f64)]) -> Result<()> {
        self.write(|event| {
            field_varint(event, 2, step);
            let mut summary = Vec::new();
            for (tag, value) in scalars {
                let mut entry = Vec::new();
                field_bytes(&mut entry, 1, tag.as_bytes());
                entry.push(2 << 3 | 5); // a float
                entry.extend((*value as f32).to_le_bytes());
                field_bytes(&mut summary, 1, &entry);
            }
            field_bytes(event, 5, &summary);
        })
    }

    fn write(&mut self, content: impl FnOnce(&mut Vec<u8>)) -> Result<()> {
        let mut event = vec![1 << 3 | 1]; // a double
        event.extend(now().to_le_bytes());
        content(&mut event);
        let length = (event.len() as u64).to_le_bytes();
        let mut record = length.to_vec();
        record.extend(masked(&length).to_le_bytes());
        record.extend(&event);
        record.extend(masked(&event).to_le_bytes());
        self.file.write_all(&record).map_err(|e| failed(&self.path, &e))
    }
}

fn failed(path: &Path, error: &std::io::Error) -> CliError {
    let what = format!("cannot write the event file: {error}");
    CliError::new(what, path.display(), "free some space, and go on with --resume")
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

fn varint(bytes: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
}

fn field_varint(bytes: &mut Vec<u8>, field: u8, value: u64) {
    bytes.push(field << 3);
    varint(bytes, value);
}

fn field_bytes(bytes: &mut Vec<u8>, field: u8, content: &[u8]) {
    bytes.push(field << 3 | 2);
    varint(bytes, content.len() as u64);
    bytes.extend(content);
}

/// The checksum as records hold it: rotated and shifted, since checksums of checksums are weak.
fn masked(bytes: &[u8]) -> u32 {
    crc32c(bytes).rotate_right(15).wrapping_add(0xA282_EAD8)
}

/// CRC-32C (Castagnoli), bit by bit: metrics are small.
fn crc32c(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| {
            (crc >> 1) ^ (0x82F6_3B78 & (crc & 1).wrapping_neg())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksum_is_castagnoli() {
        assert_eq!(crc32c(b"123456789"), 0xE306_9283); // RFC 3720, B.4 and the catalogue's check value
        assert_eq!(crc32c(&[0; 32]), 0x8A91_36AA);
    }

    #[test]
    fn encodes_fields_as_protocol_buffers() {
        let mut bytes = Vec::new();
        field_varint(&mut bytes, 2, 300);
        field_bytes(&mut bytes, 1, b"ab");
        assert_eq!(bytes, [0x10, 0xAC, 0x02, 0x0A, 2, b'a', b'b']);
    }
}
