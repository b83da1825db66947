//! Packed bits or counts: the kind of bytes that have no header.

/// The kind of a sample of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ByteKind {
    /// Every bit of a byte is set equally often: eight pixels.
    Packed,
    /// Low bits differ from high ones, or high ones are never set: one sample.
    Counts,
    /// As `Counts`, in pairs with the high byte second.
    WideCounts,
    /// All zero, or too few set bits.
    Unclear,
}

/// Least number of set bits for comparing their rates.
const MIN_SET_BITS: f64 = 400.0;

/// Largest relative difference between the rates of packed bits, whose columns see the same scene.
const RATE_TOLERANCE: f64 = 0.25;

impl ByteKind {
    pub(crate) fn of(bytes: &[u8]) -> Self {
        // Counts every value at even and odd places in one pass over the bytes.
        let mut seen = [[0u64; 256]; 2];
        for (i, &byte) in bytes.iter().enumerate() {
            seen[i % 2][usize::from(byte)] += 1;
        }
        let set = |bit: u32, odd: usize| {
            let chosen = seen[odd].iter().enumerate().filter(|(value, _)| value >> bit & 1 == 1);
            chosen.map(|(_, &count)| count).sum::<u64>() as f64
        };
        let rates: Vec<f64> = (0..8).map(|bit| set(bit, 0) + set(bit, 1)).collect();
        let total: f64 = rates.iter().sum();
        if total < MIN_SET_BITS {
            return Self::Unclear;
        }
        let mean = total / 8.0;
        let noise = 4.0 / mean.sqrt();
        if rates.iter().all(|rate| (rate / mean - 1.0).abs() < RATE_TOLERANCE + noise) {
            return Self::Packed;
        }
        // Samples of 9 to 12 bits: nothing above bit 3 of the high byte, much in the low byte.
        let high: f64 = (4..8).map(|bit| set(bit, 1)).sum();
        let low: f64 = (0..8).map(|bit| set(bit, 0)).sum();
        let odd: f64 = (0..8).map(|bit| set(bit, 1)).sum();
        if high == 0.0 && odd < 0.5 * low { Self::WideCounts } else { Self::Counts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};

    fn bytes(mut f: impl FnMut(&mut dyn FnMut() -> f64) -> u8) -> Vec<u8> {
        let mut rng = Streams::new(3).row(Domain::Pattern, 0, 0);
        let mut draw = || uniform(&mut rng);
        (0..100_000).map(|_| f(&mut draw)).collect()
    }

    #[test]
    fn distinguishes_bits_from_counts() {
        for rate in [0.01, 0.1, 0.5, 0.9] {
            let packed = bytes(|u| (0..8).fold(0, |b, i| b | u8::from(u() < rate) << i));
            assert_eq!(ByteKind::of(&packed), ByteKind::Packed, "{rate}");
        }
        for top in [2.0, 8.0, 16.0, 64.0, 200.0] {
            let counts = bytes(|u| (u() * u() * top) as u8);
            assert_eq!(ByteKind::of(&counts), ByteKind::Counts, "{top}");
        }
        let mut odd = false;
        let wide = bytes(|u| {
            odd = !odd;
            if odd { (u() * 256.0) as u8 } else { (u() * 3.0) as u8 }
        });
        assert_eq!(ByteKind::of(&wide), ByteKind::WideCounts);
        assert_eq!(ByteKind::of(&[0; 1000]), ByteKind::Unclear);
    }
}
