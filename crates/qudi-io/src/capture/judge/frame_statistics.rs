//! Numbers of single frames, from one look at each.

use multiversion::multiversion;
use qudi_core::Size;

/// Blocks along each side of a frame.
const SIDE: usize = 8;

/// Blocks of a frame.
pub(super) const BLOCKS: usize = SIDE * SIDE;

/// Share of the pixels at one value from which on a frame is constant.
pub(super) const CONSTANT_SHARE: f64 = 0.95;

/// Rows of bits that are counted in bytes, eight to the pixel, before these overflow.
const MAX_BYTE_ROWS: usize = 31;

/// Elements of a row that are looked at together.
const LANE: usize = 32;

/// Numbers of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::capture) struct FrameStatistics {
    /// Sum of all counts.
    pub(in crate::capture) sum: u64,
    /// Pixels with counts.
    pub(super) lit: u32,
    /// Largest count.
    pub(super) largest: u16,
    /// True if nearly all pixels have the largest count.
    pub(in crate::capture) is_constant: bool,
    /// All counts, bit by bit.
    pub(super) bits: u16,
    /// Hash of all counts.
    pub(super) hash: u64,
}

/// Sums of the counts in the blocks of frames.
#[derive(Clone, Copy, Debug)]
pub(in crate::capture) struct Blocks(pub(super) [u32; BLOCKS]);

/// A hash over words, in four lanes that do not wait for each other.
struct Hash([u64; 4]);

impl Hash {
    fn new() -> Self {
        Self([0xcbf2_9ce4_8422_2325, 0x9ae1_6a3b_2f90_404f, 0xc3a5_c85c_97cb_3127, 1])
    }

    fn add(&mut self, lane: usize, word: u64) {
        let hash = &mut self.0[lane];
        *hash = (*hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    }

    fn value(mut self) -> u64 {
        for lane in 1..4 {
            let word = self.0[lane];
            self.add(0, word);
        }
        self.0[0]
    }
}

/// Returns the first row of a frame that belongs to row `band` of blocks.
fn first_row(band: usize, height: usize) -> usize {
    (band * height).div_ceil(SIDE)
}

/// Returns the elements of a row from number `from` on, and zeros after its end.
#[inline]
fn lane<T: Copy + Default>(row: &[T], from: usize) -> [T; LANE] {
    let rest = &row[from..];
    rest.first_chunk().copied().unwrap_or_else(|| {
        let mut lane = [T::default(); LANE];
        lane[..rest.len()].copy_from_slice(rest);
        lane
    })
}

/// Numbers of some rows of a frame.
#[derive(Default)]
struct Rows {
    lit: u32,
    bits: u16,
    largest: u16,
}

/// Sums each column of some rows of counts, and looks at all of them.
#[multiversion(targets("x86_64+avx2"))]
fn add_rows(rows: &[u16], sums: &mut [u32]) -> Rows {
    let width = sums.len();
    let mut seen = Rows::default();
    for (n, sums) in sums.chunks_mut(LANE).enumerate() {
        let (mut all, mut lit) = ([0u32; LANE], [0u32; LANE]);
        let (mut bits, mut largest) = ([0u16; LANE], [0u16; LANE]);
        for row in rows.chunks_exact(width) {
            for (i, count) in lane(row, n * LANE).into_iter().enumerate() {
                all[i] += u32::from(count);
                lit[i] += u32::from(count > 0);
                bits[i] |= count;
                largest[i] = largest[i].max(count);
            }
        }
        sums.copy_from_slice(&all[..sums.len()]);
        seen.lit += lit.iter().sum::<u32>();
        seen.bits |= bits.iter().fold(0, |bits, lane| bits | lane);
        seen.largest = largest.iter().fold(seen.largest, |most, &lane| most.max(lane));
    }
    seen
}

/// Counts the ones in each column of bytes of at most [`MAX_BYTE_ROWS`] rows.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl+avx512bitalg", "x86_64+avx2"))]
fn count_ones(rows: &[u8], ones: &mut [u8]) {
    let row_bytes = ones.len();
    for (n, ones) in ones.chunks_mut(LANE).enumerate() {
        let mut sums = [0u8; LANE];
        for row in rows.chunks_exact(row_bytes) {
            for (sum, byte) in sums.iter_mut().zip(lane(row, n * LANE)) {
                *sum += byte.count_ones() as u8;
            }
        }
        ones.copy_from_slice(&sums[..ones.len()]);
    }
}

impl FrameStatistics {
    /// Looks at the counts of a frame.
    pub(in crate::capture) fn of(counts: &[u16], size: Size) -> (Self, Blocks) {
        let mut blocks = [0u32; BLOCKS];
        let mut own = Self::default();
        let width = size.width.div_ceil(SIDE);
        let mut sums = vec![0u32; size.width];
        for (at, blocks) in blocks.chunks_exact_mut(SIDE).enumerate() {
            let rows = first_row(at, size.height)..first_row(at + 1, size.height);
            if rows.is_empty() {
                continue;
            }
            let rows = &counts[rows.start * size.width..rows.end * size.width];
            let seen = add_rows(rows, &mut sums);
            own.lit += seen.lit;
            own.bits |= seen.bits;
            own.largest = own.largest.max(seen.largest);
            for (block, part) in blocks.iter_mut().zip(sums.chunks(width)) {
                *block = part.iter().sum();
            }
        }
        let mut hash = Hash::new();
        let (sixteens, rest) = counts.as_chunks::<16>();
        for words in sixteens {
            for (lane, word) in words.as_chunks::<4>().0.iter().enumerate() {
                hash.add(lane, word.iter().rev().fold(0, |all, &c| all << 16 | u64::from(c)));
            }
        }
        for &count in rest {
            hash.add(0, count.into());
        }
        own.hash = hash.value();
        own.sum = blocks.iter().map(|&sum| u64::from(sum)).sum();
        let (pixels, most) = (size.pixels() as f64, own.largest);
        if most > 0 && own.sum as f64 > CONSTANT_SHARE * pixels * f64::from(most) {
            let at_most: u32 = counts.iter().map(|&count| u32::from(count == most)).sum();
            own.is_constant = f64::from(at_most) > CONSTANT_SHARE * pixels;
        }
        (own, Blocks(blocks))
    }

    /// Looks at a binary frame, 8 pixels to the byte along rows.
    pub(super) fn of_packed(bytes: &[u8], size: Size) -> (Self, Blocks) {
        let mut blocks = [0u32; BLOCKS];
        let row_bytes = size.width.div_ceil(8);
        let width = row_bytes.div_ceil(SIDE);
        let mut ones = vec![0u8; row_bytes];
        for (at, blocks) in blocks.chunks_exact_mut(SIDE).enumerate() {
            let rows = first_row(at, size.height)..first_row(at + 1, size.height);
            let rows = &bytes[rows.start * row_bytes..rows.end * row_bytes];
            for rows in rows.chunks(MAX_BYTE_ROWS * row_bytes) {
                count_ones(rows, &mut ones);
                for (block, part) in blocks.iter_mut().zip(ones.chunks(width)) {
                    *block += part.iter().map(|&ones| u32::from(ones)).sum::<u32>();
                }
            }
        }
        let mut hash = Hash::new();
        let (words, rest) = bytes.as_chunks::<32>();
        for words in words {
            for (lane, word) in words.as_chunks().0.iter().enumerate() {
                hash.add(lane, u64::from_le_bytes(*word));
            }
        }
        for &byte in rest {
            hash.add(0, byte.into());
        }
        let lit: u32 = blocks.iter().sum();
        let largest = u16::from(lit > 0);
        let is_constant = f64::from(lit) > CONSTANT_SHARE * size.pixels() as f64;
        let (sum, hash) = (u64::from(lit), hash.value());
        (Self { sum, lit, largest, is_constant, bits: largest, hash }, Blocks(blocks))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_frames_have_the_numbers_of_their_counts() {
        for (height, width) in [(300, 64), (5, 13), (70, 200), (8, 8), (1, 1)] {
            let size = Size { height, width };
            let row_bytes = width.div_ceil(8);
            let mut bytes: Vec<u8> =
                (0..height * row_bytes).map(|i| (i * i * 31 + 7 * i) as u8).collect();
            for row in bytes.chunks_mut(row_bytes) {
                row[row_bytes - 1] &= (0xff00 >> ((width - 1) % 8 + 1)) as u8;
            }
            let counts: Vec<u16> = (0..height * width)
                .map(|i| {
                    let (y, x) = (i / width, i % width);
                    u16::from(bytes[y * row_bytes + x / 8] >> (7 - x % 8) & 1)
                })
                .collect();
            let (packed, of_bits) = FrameStatistics::of_packed(&bytes, size);
            let (plain, of_counts) = FrameStatistics::of(&counts, size);
            let numbers = |s: &FrameStatistics| (s.sum, s.lit, s.largest, s.is_constant, s.bits);
            assert_eq!(numbers(&packed), numbers(&plain), "{size}");
            if width % 64 == 0 {
                assert_eq!(of_bits.0, of_counts.0, "{size}");
            }
        }
    }

    #[test]
    fn every_count_changes_the_hash() {
        let size = Size { height: 5, width: 13 };
        let counts: Vec<u16> = (0..size.pixels() as u16).collect();
        let (plain, _) = FrameStatistics::of(&counts, size);
        for i in 0..counts.len() {
            let mut other = counts.clone();
            other[i] += 1;
            assert_ne!(FrameStatistics::of(&other, size).0.hash, plain.hash, "{i}");
        }
        let mut turned = counts.clone();
        turned.swap(3, 40);
        assert_ne!(FrameStatistics::of(&turned, size).0.hash, plain.hash);
    }
}
