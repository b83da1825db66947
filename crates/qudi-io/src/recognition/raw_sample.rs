//! Headerless `.bin` files of 512-pixel cameras: facts from name, length and bits.

use super::bit_order::{Z_SCORE_THRESHOLD, bit_order_z_score, standard_errors};
use super::byte_kind::ByteKind;
use crate::description::BitOrder;
use crate::frames::bit_sums::{MAX_FRAMES, add_packed};
use qudi_core::Size;
use qudi_core::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Bytes of a frame of 512 x 512 bits, or of two half-array frames of 256 x 512.
pub(crate) const FRAME_BYTES: usize = 32_768;

/// Length of every SwissSPAD2 file.
pub(crate) const SWISSSPAD_FILE_BYTES: u64 = 8 << 20;

/// The camera whose naming convention a file follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Convention {
    /// `RAW00000.bin`, or anything in `acq00000/`.
    Spad512s,
    /// `filename12.bin`, or files of 8 MiB in numbered folders.
    SwissSpad2,
    /// Any other.
    Unknown,
}

/// Facts about a `.bin` file, or about the first one of a folder.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RawSample {
    pub(crate) convention: Convention,
    pub(crate) length: u64,
    pub(crate) kind: ByteKind,
    /// Bit order, if the picture shows it.
    pub(crate) order: Option<BitOrder>,
    /// `Some(true)` if rows alternate as in a full SwissSPAD2 array; `None` if the picture does not show it.
    pub(crate) full_array: Option<bool>,
}

impl RawSample {
    /// Reads the facts about a `.bin` file.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let io = |e| Error::io("read", path, e);
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut bytes = Vec::new();
        file.take(SWISSSPAD_FILE_BYTES).read_to_end(&mut bytes).map_err(io)?;
        bytes.truncate(bytes.len() / FRAME_BYTES * FRAME_BYTES);
        let (order, full_array) = pictures(&bytes);
        let kind = ByteKind::of(&bytes[..bytes.len().min(1 << 20)]);
        Ok(Self { convention: convention(path), length, kind, order, full_array })
    }
}

/// Returns the name of a file without its extension.
pub(crate) fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

fn convention(path: &Path) -> Convention {
    let name = stem(path);
    let numbered = |text: &str, prefix: &str| {
        text.strip_prefix(prefix).is_some_and(|rest| {
            !rest.is_empty()
                && rest.trim_start_matches('_').chars().all(|c| c.is_ascii_digit() || c == '.')
        })
    };
    let folder = path.parent().map(stem).unwrap_or_default();
    if numbered(&name, "RAW") || name.starts_with("RAW_") || numbered(&folder, "acq") {
        Convention::Spad512s
    } else if numbered(&name, "filename") || numbered(&folder, "") {
        Convention::SwissSpad2
    } else {
        Convention::Unknown
    }
}

/// Returns the bit order and whether rows of 64 bytes alternate, from the sum of some frames.
fn pictures(bytes: &[u8]) -> (Option<BitOrder>, Option<bool>) {
    let size = Size { height: 512, width: 512 };
    let mut sums = vec![0u32; size.pixels()];
    for frames in bytes.chunks(MAX_FRAMES * FRAME_BYTES) {
        add_packed(frames, FRAME_BYTES, BitOrder::Msb, &mut sums);
    }
    let msb = bit_order_z_score(&sums, size);
    let order = (msb.abs() > Z_SCORE_THRESHOLD).then_some(if msb > 0.0 {
        BitOrder::Msb
    } else {
        BitOrder::Lsb
    });
    // Next rows against rows after next, in units of 16 rows by 16 columns.
    let roots: Vec<f32> = sums.iter().map(|&sum| (sum as f32).sqrt()).collect();
    let mut units = Vec::new();
    for y in (0..496).step_by(16) {
        for x in (0..512).step_by(16) {
            let unit: f32 = (y..y + 16)
                .map(|y| {
                    let row =
                        |dy: usize| roots[(y + dy).min(511) * 512 + x..][..16].iter().sum::<f32>();
                    (row(0) - row(1)).abs() - (row(0) - row(2)).abs()
                })
                .sum();
            units.push(f64::from(unit));
        }
    }
    let alternating = standard_errors(&units).unwrap_or(0.0);
    let full = if alternating > Z_SCORE_THRESHOLD {
        Some(true)
    } else {
        // Without structure neither arrangement shows.
        (order.is_some() && alternating < 0.5 * Z_SCORE_THRESHOLD).then_some(false)
    };
    (order, full)
}
