//! Numbers of single frames, from one look at each.

use qudi_core::Size;

/// Blocks along each side of a frame.
const SIDE: usize = 8;

/// Blocks of a frame.
pub(super) const BLOCKS: usize = SIDE * SIDE;

/// Numbers of one frame.
#[derive(Clone, Debug)]
pub(super) struct FrameStatistics {
    /// Sum of all counts.
    pub(super) sum: u64,
    /// Pixels with counts.
    pub(super) lit: u32,
    /// Largest count, and the pixels that have it.
    pub(super) largest: (u16, u32),
    /// All counts, bit by bit.
    pub(super) bits: u16,
    /// Hash of all counts.
    pub(super) hash: u64,
    /// Sum of the counts in each block.
    pub(super) blocks: [u32; BLOCKS],
}

impl FrameStatistics {
    /// Looks at the counts of a frame.
    pub(super) fn of(counts: &[u16], size: Size) -> Self {
        let mut blocks = [0u32; BLOCKS];
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let (mut lit, mut bits, mut most) = (0u32, 0u16, 0u16);
        let width = size.width.div_ceil(SIDE);
        for (y, row) in counts.chunks_exact(size.width).enumerate() {
            let down = y * SIDE / size.height;
            for (across, part) in row.chunks(width).enumerate() {
                let sum: u32 = part.iter().map(|&count| u32::from(count)).sum();
                blocks[down * SIDE + across] += sum;
                lit += part.iter().map(|&count| u32::from(count > 0)).sum::<u32>();
                bits |= part.iter().fold(0, |bits, &count| bits | count);
                most = part.iter().fold(most, |most, &count| most.max(count));
            }
            // Four counts to the word.
            for words in row.chunks(4) {
                let word = words.iter().fold(0, |word, &count| word << 16 | u64::from(count));
                hash = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
            }
        }
        let at_most = counts.iter().map(|&count| u32::from(count == most)).sum();
        let sum = blocks.iter().map(|&sum| u64::from(sum)).sum();
        Self { sum, lit, largest: (most, at_most), bits, hash, blocks }
    }
}
