//! Sums of packed binary frames without unpacking them: 15 frames are added bit by bit with
//! full adders over 512 pixels at once, and only the four sum bits are spread out to counters.

use crate::description::BitOrder;
use rayon::prelude::*;

/// Words of a block: 512 pixels, one cache line of every frame, so that each line is loaded once.
const WORDS: usize = 8;
type Block = [u64; WORDS];

/// Frames added by one tree of full adders: the largest number that four bits hold.
const GROUP: usize = 15;

/// Largest number of frames that byte counters hold: 17 groups.
pub(crate) const MAX_FRAMES: usize = 255;

/// Bytes of a frame handled by one task.
const PIECE_BYTES: usize = 1024;

/// Eight pixels of a byte as the eight bytes of a word, `SPREAD[order][byte]`.
static SPREAD: [[u64; 256]; 2] = spread();

const fn spread() -> [[u64; 256]; 2] {
    let mut tables = [[0u64; 256]; 2];
    let mut byte = 0;
    while byte < 256 {
        let mut pixel = 0;
        while pixel < 8 {
            let place = 1u64 << (8 * pixel);
            if byte >> (7 - pixel) & 1 == 1 {
                tables[0][byte] |= place;
            }
            if byte >> pixel & 1 == 1 {
                tables[1][byte] |= place;
            }
            pixel += 1;
        }
        byte += 1;
    }
    tables
}

pub(crate) fn spread_table(order: BitOrder) -> &'static [u64; 256] {
    match order {
        BitOrder::Msb => &SPREAD[0],
        BitOrder::Lsb => &SPREAD[1],
    }
}

/// Adds up to [`MAX_FRAMES`] frames of `frame_bytes` packed bytes to `sums`, 8 per stored byte.
pub(crate) fn add_packed(frames: &[u8], frame_bytes: usize, order: BitOrder, sums: &mut [u32]) {
    debug_assert!(frames.len() <= MAX_FRAMES * frame_bytes);
    debug_assert_eq!(sums.len(), frame_bytes * 8);
    let table = spread_table(order);
    sums.par_chunks_mut(PIECE_BYTES * 8).enumerate().for_each(|(piece, sums)| {
        for (block, sums) in sums.chunks_mut(WORDS * 64).enumerate() {
            let from = piece * PIECE_BYTES + block * WORDS * 8;
            let line = |frame: &[u8]| load(&frame[from..from + sums.len() / 8]);
            let mut counters = [0u64; WORDS * 8];
            for group in frames.chunks(GROUP * frame_bytes) {
                let mut lines = [[0u64; WORDS]; GROUP];
                for (to, frame) in lines.iter_mut().zip(group.chunks_exact(frame_bytes)) {
                    *to = line(frame);
                }
                for (weight, plane) in add_fifteen(&lines).iter().enumerate() {
                    for (word, counters) in plane.iter().zip(counters.chunks_exact_mut(8)) {
                        for (byte, counter) in word.to_le_bytes().iter().zip(counters) {
                            *counter += table[usize::from(*byte)] << weight;
                        }
                    }
                }
            }
            for (sums, counter) in sums.chunks_exact_mut(8).zip(counters) {
                for (sum, count) in sums.iter_mut().zip(counter.to_le_bytes()) {
                    *sum += u32::from(count);
                }
            }
        }
    });
}

/// Loads a cache line, or the rest of a frame at its end.
fn load(bytes: &[u8]) -> Block {
    if let Ok(line) = <&[u8; WORDS * 8]>::try_from(bytes) {
        return words(line);
    }
    let mut line = [0u8; WORDS * 8];
    line[..bytes.len()].copy_from_slice(bytes);
    words(&line)
}

fn words(line: &[u8; WORDS * 8]) -> Block {
    let mut block = [0; WORDS];
    for (word, bytes) in block.iter_mut().zip(line.chunks_exact(8)) {
        *word = u64::from_le_bytes(bytes.try_into().expect("8 bytes"));
    }
    block
}

/// Adds three planes bit by bit: (ones, twos).
fn add_three(a: &Block, b: &Block, c: &Block) -> (Block, Block) {
    let (mut ones, mut twos) = ([0; WORDS], [0; WORDS]);
    for i in 0..WORDS {
        let half = a[i] ^ b[i];
        ones[i] = half ^ c[i];
        twos[i] = (a[i] & b[i]) | (half & c[i]);
    }
    (ones, twos)
}

/// Adds 15 planes bit by bit: ones, twos, fours, eights.
fn add_fifteen(x: &[Block; GROUP]) -> [Block; 4] {
    let (ones, a) = add_three(&x[0], &x[1], &x[2]);
    let (ones, b) = add_three(&ones, &x[3], &x[4]);
    let (ones, c) = add_three(&ones, &x[5], &x[6]);
    let (twos, p) = add_three(&a, &b, &c);
    let (ones, a) = add_three(&ones, &x[7], &x[8]);
    let (ones, b) = add_three(&ones, &x[9], &x[10]);
    let (twos, q) = add_three(&twos, &a, &b);
    let (ones, a) = add_three(&ones, &x[11], &x[12]);
    let (ones, b) = add_three(&ones, &x[13], &x[14]);
    let (twos, r) = add_three(&twos, &a, &b);
    let (fours, eights) = add_three(&p, &q, &r);
    [ones, twos, fours, eights]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn one_by_one(frames: &[u8], frame_bytes: usize, order: BitOrder) -> Vec<u32> {
        let mut sums = vec![0; frame_bytes * 8];
        for frame in frames.chunks(frame_bytes) {
            for (i, sum) in sums.iter_mut().enumerate() {
                let bit = if order == BitOrder::Msb { 7 - i % 8 } else { i % 8 };
                *sum += u32::from(frame[i / 8] >> bit & 1);
            }
        }
        sums
    }

    #[test]
    fn bit_sums_do_not_overflow() {
        let frames = vec![0xff; 255 * 130];
        let mut sums = vec![1; 130 * 8];
        add_packed(&frames, 130, BitOrder::Msb, &mut sums);
        assert!(sums.iter().all(|&sum| sum == 256));
    }

    proptest! {
        #[test]
        fn sums_are_those_of_single_pixels(
            frame_bytes in 1usize..150, frames in 0usize..70, seed: u64, lsb: bool,
        ) {
            let order = if lsb { BitOrder::Lsb } else { BitOrder::Msb };
            let mut state = seed | 1;
            let bytes: Vec<u8> = (0..frame_bytes * frames)
                .map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    (state >> 40) as u8
                })
                .collect();
            let mut sums = vec![0; frame_bytes * 8];
            add_packed(&bytes, frame_bytes, order, &mut sums);
            prop_assert_eq!(sums, one_by_one(&bytes, frame_bytes, order));
        }
    }
}
