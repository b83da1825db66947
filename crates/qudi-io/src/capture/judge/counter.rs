//! Frame counters that cameras write into the first pixels of the first row, or the last of the last one.

use qudi_core::Size;

/// Pixels at the beginning of the first row and at the end of the last one that are looked at.
const EDGE: usize = 32;

/// Fewest frames that show a counter.
const MIN_FRAMES: usize = 12;

/// Frames that are followed at most.
const MAX_FRAMES: usize = 1 << 16;

/// Share of the steps of a counter that are one.
const MIN_SHARE: f64 = 0.8;

/// Share of the frames in which a higher digit of a counter changes at most.
const RARE: f64 = 0.125;

/// The same share of bytes of packed frames, whose higher digits are carries of a byte.
const RARE_BYTE: f64 = 1.0 / 64.0;

/// Pixels next to a counter that may be its higher digits.
const DIGITS: usize = 8;

/// A frame as it is stored.
#[derive(Clone, Copy)]
pub(super) enum Stored<'a> {
    /// One count per pixel.
    Counts(&'a [u16]),
    /// 8 pixels to the byte along rows.
    Packed(&'a [u8], Size),
}

/// Values of consecutive frames where counters are: counts, or bytes of packed ones.
#[derive(Debug, Default)]
pub(super) struct Edges {
    /// Values of a frame.
    length: usize,
    /// Values that are looked at on each side.
    edge: usize,
    /// Pixels of a value.
    pixels: usize,
    /// Values of each frame: first the ones of the first row, then of the last row.
    values: Vec<u16>,
}

/// A counter that was found.
#[derive(Debug, PartialEq)]
pub(super) struct Counter {
    /// Stored pixels that it takes.
    pub(super) pixels: Vec<usize>,
    /// Frames before which it jumps, and how many are missing there.
    pub(super) jumps: Vec<(u64, u64)>,
}

impl Edges {
    /// Adds a frame.
    pub(super) fn push(&mut self, frame: Stored<'_>) {
        match frame {
            Stored::Counts(counts) if counts.len() >= 4 * EDGE => {
                (self.length, self.edge, self.pixels) = (counts.len(), EDGE, 1);
                if self.values.len() < MAX_FRAMES * 2 * EDGE {
                    self.values.extend(&counts[..EDGE]);
                    self.values.extend(&counts[counts.len() - EDGE..]);
                }
            }
            Stored::Packed(bytes, size) if size.width.is_multiple_of(8) && bytes.len() >= EDGE => {
                let edge = EDGE / 8;
                (self.length, self.edge, self.pixels) = (bytes.len(), edge, 8);
                if self.values.len() < MAX_FRAMES * 2 * edge {
                    let ends = bytes[..edge].iter().chain(&bytes[bytes.len() - edge..]);
                    self.values.extend(ends.map(|&byte| u16::from(byte)));
                }
            }
            _ => {}
        }
    }

    /// Finds the counter, if there is one: in bytes also one whose bits are in the other order.
    pub(super) fn counter(&mut self) -> Option<Counter> {
        let found = self.find();
        if found.is_some() || self.pixels != 8 {
            return found;
        }
        for value in &mut self.values {
            *value = u16::from((*value as u8).reverse_bits());
        }
        self.find()
    }

    fn find(&self) -> Option<Counter> {
        let edge = self.edge;
        if edge == 0 {
            return None;
        }
        let frames = self.values.len() / (2 * edge);
        let values = |at: usize| {
            self.values.iter().copied().skip(at).step_by(2 * edge).collect::<Vec<u16>>()
        };
        let of_one = |values: &[u16]| steps(values).iter().filter(|&&step| step == 1).count();
        let counts = |at: &usize| {
            frames >= MIN_FRAMES && of_one(&values(*at)) as f64 >= MIN_SHARE * (frames - 1) as f64
        };
        let found: Vec<usize> = (0..2 * edge).filter(counts).collect();
        let (first, last) = (*found.first()?, *found.last()?);
        // Higher digits next to it hardly change.
        let rare = if self.pixels == 1 { RARE } else { RARE_BYTE };
        let is_digit = |&at: &usize| {
            let values = values(at);
            let changes = values.windows(2).filter(|pair| pair[0] != pair[1]).count();
            changes as f64 <= (rare * frames as f64).max(1.0)
        };
        let side = if first < edge { 0..edge } else { edge..2 * edge };
        let last = if side.contains(&last) { last } else { side.end - 1 };
        let before = (side.start..first).rev().take(DIGITS).take_while(is_digit).count();
        let after = (last + 1..side.end).take(DIGITS).take_while(is_digit).count();
        let place = |at: usize| if at < edge { at } else { self.length - 2 * edge + at };
        let pixels = (first - before..=last + after).map(place);
        let pixels = pixels.flat_map(|at| at * self.pixels..(at + 1) * self.pixels);
        let jumps = (1..).zip(steps(&values(first))).filter(|&(_, step)| (2..128).contains(&step));
        Some(Counter {
            pixels: pixels.collect(),
            jumps: jumps.map(|(frame, step)| (frame, u64::from(step) - 1)).collect(),
        })
    }
}

/// Returns how far values rise from frame to frame: binary ones, of bytes or words, or of two decimal digits.
fn steps(values: &[u16]) -> Vec<u16> {
    let largest = values.iter().copied().max().unwrap_or(0);
    let is_decimal = |value: &u16| value & 0xf < 10 && value >> 4 < 10;
    let decimal = |value: u16| (value >> 4) * 10 + (value & 0xf);
    let pairs = || values.windows(2);
    let plain = |pair: &[u16]| match largest {
        0..256 => (pair[1].wrapping_sub(pair[0])) & 0xff,
        _ => pair[1].wrapping_sub(pair[0]),
    };
    if values.iter().all(is_decimal) && pairs().any(|pair| plain(pair) == 7) {
        return pairs().map(|pair| (100 + decimal(pair[1]) - decimal(pair[0])) % 100).collect();
    }
    pairs().map(plain).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: usize = 24 * 32;

    /// Returns edges of noisy frames, in which `write` writes number `n` into frame `n`.
    fn edges(numbers: &[usize], write: impl Fn(usize, &mut [u16])) -> Edges {
        let mut edges = Edges::default();
        let mut state = 7_u32;
        for &number in numbers {
            let mut noise = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 29) as u16
            };
            let mut counts: Vec<u16> = (0..PIXELS).map(|_| noise()).collect();
            write(number, &mut counts);
            edges.push(Stored::Counts(&counts));
        }
        edges
    }

    #[test]
    fn counters_of_bytes_words_and_digits_are_found() {
        let numbers: Vec<usize> = (1000..1030).collect();
        let bytes = |number: usize, counts: &mut [u16]| {
            for (pixel, shift) in counts.iter_mut().zip([24, 16, 8, 0, 0, 0, 0, 0]) {
                *pixel = (number >> shift & 255) as u16;
            }
        };
        let found = edges(&numbers, bytes).counter().unwrap();
        assert_eq!((found.pixels, found.jumps), ((0..8).collect(), vec![]));
        let word = |number: usize, counts: &mut [u16]| counts[PIXELS - 1] = number as u16;
        let found = edges(&numbers, word).counter().unwrap();
        assert_eq!(found.pixels, [PIXELS - 1]);
        let digits = |number: usize, counts: &mut [u16]| {
            let two = |n: usize| (n / 10 % 10 * 16 + n % 10) as u16;
            counts[..4].copy_from_slice(&[0, 0, two(number / 100), two(number)]);
        };
        let found = edges(&numbers, digits).counter().unwrap();
        assert_eq!((found.pixels, found.jumps), ((0..4).collect(), vec![]));
    }

    #[test]
    fn counters_of_packed_frames_are_found() {
        let size = Size { height: 24, width: 32 };
        let mut state = 7_u32;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        for reversed in [false, true] {
            let mut edges = Edges::default();
            for number in (1000_u32..1030).chain(1033..1050) {
                let mut bytes: Vec<u8> = (0..96).map(|_| noise()).collect();
                bytes[..4].copy_from_slice(&number.to_be_bytes());
                if reversed {
                    for byte in &mut bytes {
                        *byte = byte.reverse_bits();
                    }
                }
                edges.push(Stored::Packed(&bytes, size));
            }
            let found = edges.counter().unwrap();
            assert_eq!((found.pixels, found.jumps), ((0..32).collect(), vec![(30, 3)]));
        }
    }

    #[test]
    fn jumps_tell_missing_frames_and_noise_is_no_counter() {
        let numbers: Vec<usize> = (0..14).chain(17..40).collect();
        let word = |number: usize, counts: &mut [u16]| counts[0] = number as u16;
        assert_eq!(edges(&numbers, word).counter().unwrap().jumps, [(14, 3)]);
        assert_eq!(edges(&numbers, |_, _| ()).counter(), None);
        assert_eq!(edges(&numbers[..9], word).counter(), None);
    }
}
