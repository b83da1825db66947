//! Binary frames, 8 pixels to the byte.

use super::bit_sums::{MAX_FRAMES, add_packed, spread_table};
use super::count_frames::CountFrames;
use super::frame_bytes::FrameBytes;
use crate::description::{BitOrder, PackAxis};
use qudi_core::Result;
use qudi_core::Size;
use std::ops::Range;

/// Place of stored bits that belong to no pixel.
pub(crate) const NO_PIXEL: u32 = u32::MAX;

/// Bytes read at once while summing: they fit into the second-level cache with the counters.
const CHUNK_BYTES: usize = 1 << 20;

/// The placement of the bits of a stored frame.
pub(crate) enum Placement {
    /// Bits in order, row by row, without padding.
    Straight,
    /// Place of each stored byte among the bytes of the image, whose rows are whole bytes.
    Bytes(Vec<u32>),
    /// Pixel of each stored bit, or [`NO_PIXEL`].
    Map(Vec<u32>),
}

impl Placement {
    /// Creates the placement of rows (or columns) padded to whole bytes.
    pub(crate) fn packed(size: Size, axis: PackAxis, transposed: bool) -> Self {
        let Size { height, width } = size;
        if axis == PackAxis::Width && !transposed && width.is_multiple_of(8) {
            return Self::Straight;
        }
        let along_height = axis == PackAxis::Height;
        let (rows, columns) = stored_bytes(size, axis);
        let mut map = Vec::with_capacity(rows * columns * 8);
        for i in 0..rows * columns {
            let (row, column) =
                if transposed { (i % rows, i / rows) } else { (i / columns, i % columns) };
            for bit in 0..8 {
                let (y, x) =
                    if along_height { (row * 8 + bit, column) } else { (row, column * 8 + bit) };
                map.push(if y < height && x < width { (y * width + x) as u32 } else { NO_PIXEL });
            }
        }
        Self::Map(map)
    }
}

/// Returns the rows and columns of bytes of a packed frame.
pub(crate) fn stored_bytes(size: Size, axis: PackAxis) -> (usize, usize) {
    match axis {
        PackAxis::Width => (size.height, size.width.div_ceil(8)),
        PackAxis::Height => (size.height.div_ceil(8), size.width),
        PackAxis::None => (size.height, size.width),
    }
}

pub(crate) struct PackedFrames {
    bytes: FrameBytes,
    order: BitOrder,
    size: Size,
    placement: Placement,
    buffer: Vec<u8>,
}

impl PackedFrames {
    pub(crate) fn new(
        bytes: FrameBytes,
        order: BitOrder,
        size: Size,
        placement: Placement,
    ) -> Self {
        Self { bytes, order, size, placement, buffer: Vec::new() }
    }
}

impl CountFrames for PackedFrames {
    fn frames(&self) -> u64 {
        self.bytes.frames()
    }

    fn size(&self) -> Size {
        self.size
    }

    fn read(&mut self, frame: u64, counts: &mut [u16]) -> Result<()> {
        self.buffer.resize(self.bytes.frame_bytes(), 0);
        self.bytes.read(frame, &mut self.buffer)?;
        let table = spread_table(self.order);
        let eights = self.buffer.iter().map(|&byte| table[usize::from(byte)].to_le_bytes());
        match &self.placement {
            Placement::Straight => {
                for (pixels, eight) in counts.chunks_exact_mut(8).zip(eights) {
                    for (pixel, bit) in pixels.iter_mut().zip(eight) {
                        *pixel = u16::from(bit);
                    }
                }
            }
            Placement::Bytes(map) => {
                for (&place, eight) in map.iter().zip(eights) {
                    let pixels = &mut counts[place as usize * 8..][..8];
                    for (pixel, bit) in pixels.iter_mut().zip(eight) {
                        *pixel = u16::from(bit);
                    }
                }
            }
            Placement::Map(map) => {
                for (places, eight) in map.chunks_exact(8).zip(eights) {
                    for (&place, bit) in places.iter().zip(eight) {
                        if place != NO_PIXEL {
                            counts[place as usize] = u16::from(bit);
                        }
                    }
                }
            }
        }
        Ok(())
    }

    fn add(&mut self, frames: Range<u64>, sums: &mut [u32]) -> Result<()> {
        let frame_bytes = self.bytes.frame_bytes();
        let at_once = (CHUNK_BYTES / frame_bytes).clamp(15, MAX_FRAMES) / 15 * 15;
        let mut stored = match self.placement {
            Placement::Straight => Vec::new(),
            Placement::Bytes(_) | Placement::Map(_) => vec![0; frame_bytes * 8],
        };
        let mut first = frames.start;
        while first < frames.end {
            let n = (frames.end - first).min(at_once as u64);
            self.buffer.resize(n as usize * frame_bytes, 0);
            self.bytes.read(first, &mut self.buffer)?;
            let to = if stored.is_empty() { &mut *sums } else { &mut stored };
            add_packed(&self.buffer, frame_bytes, self.order, to);
            first += n;
        }
        match &self.placement {
            Placement::Straight => {}
            Placement::Bytes(map) => {
                for (&place, stored) in map.iter().zip(stored.chunks_exact(8)) {
                    for (sum, stored) in sums[place as usize * 8..].iter_mut().zip(stored) {
                        *sum += stored;
                    }
                }
            }
            Placement::Map(map) => {
                for (&place, sum) in map.iter().zip(&stored) {
                    if place != NO_PIXEL {
                        sums[place as usize] += sum;
                    }
                }
            }
        }
        Ok(())
    }

    fn copy_packed(&mut self, first: u64, bytes: &mut [u8]) -> Result<bool> {
        match &self.placement {
            Placement::Straight => self.bytes.read(first, bytes)?,
            Placement::Bytes(map) => {
                self.buffer.resize(bytes.len(), 0);
                self.bytes.read(first, &mut self.buffer)?;
                let frame = map.len();
                for (to, from) in bytes.chunks_exact_mut(frame).zip(self.buffer.chunks_exact(frame))
                {
                    for (&place, &byte) in map.iter().zip(from) {
                        to[place as usize] = byte;
                    }
                }
            }
            Placement::Map(_) => return Ok(false),
        }
        if self.order == BitOrder::Lsb {
            for byte in bytes {
                *byte = byte.reverse_bits();
            }
        }
        Ok(true)
    }

    fn verify(&mut self) -> Result<()> {
        self.bytes.verify()
    }

    fn forward_only(&self) -> bool {
        self.bytes.forward_only()
    }

    fn length(&self) -> Option<u64> {
        self.bytes.length()
    }

    fn wait_for(&mut self, frames: u64, notes: &mut Vec<String>) -> Result<u64> {
        self.bytes.wait_for(frames, notes)
    }

    fn discard_before(&mut self, frame: u64) {
        self.bytes.discard_before(frame);
    }
}
