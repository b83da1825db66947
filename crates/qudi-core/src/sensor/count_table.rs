//! The fast exact path for shallow samples: one 32-bit random number and one table row per count.
//!
//! A Poisson number of mean `lambda = node + delta` is one of mean `node` plus one of mean `delta`
//! (superposition). `delta` is small, so its part is nearly always 0, and the count then follows
//! the tabulated law of the node. The upper 16 random bits decide about `delta`, the lower 16 pick
//! the count. Where 16 bits leave the answer open (about 1 in 200), more are drawn, so the result
//! has the exact law, not one rounded to 16 bits. This holds for binary sums too: the extra
//! photon falls into one of the summed frames.

use super::law::for_each_poisson;
use super::{CountLaw, Response};
use crate::random::uniform;
use rand::Rng;
use wide::i16x8;

/// Largest count of a table, 7 (3 bits): a row of eight 16-bit thresholds fills one SIMD register.
const MAX_COUNT: usize = 7;

/// Largest number of rows; for more light, nodes move apart (and `delta` draws get more frequent).
const MAX_ROWS: f32 = 8192.0;
const NODES_PER_DETECTION: f32 = 128.0;

/// Marker of counts that the fast pass leaves open.
const OPEN_COUNT: u16 = u16::MAX;

/// Number of counts that are searched for open ones at a time.
const SCAN_LENGTH: usize = 16;

/// Tabulated laws of a count over a range of expected detections.
#[derive(Clone, Debug)]
pub(crate) struct CountTable {
    law: CountLaw,
    nodes_per_detection: f32,
    /// `floor(65536 * P(y > j))` in lane j, less 2^15 so that signed comparison orders them.
    rows: Vec<i16x8>,
    /// `P(y > j)`.
    tails: Vec<[f64; MAX_COUNT]>,
}

/// Buffers of one row of pixels, kept from row to row.
#[derive(Debug, Default)]
pub(crate) struct RowScratch {
    /// Detections expected at each pixel; filled by the caller.
    pub(crate) detections: Vec<f32>,
    random: Vec<u8>,
    nodes: Vec<u32>,
    /// An extra detection is possible if the upper 16 random bits are not above this.
    limits: Vec<u16>,
}

impl CountTable {
    /// Creates a table for means up to `max_detections`, or `None` if the samples are too deep, the light too
    /// strong, or arrivals not independent (dead time): then counts are drawn directly.
    pub(crate) fn new(law: &CountLaw, max_detections: f64) -> Option<Self> {
        if usize::from(law.max_count) > MAX_COUNT || law.dead_time > 0.0 {
            return None;
        }
        // Powers of two keep `lambda - node` exact in f32.
        let mut per_detection = NODES_PER_DETECTION;
        while max_detections * f64::from(per_detection) >= f64::from(MAX_ROWS) {
            per_detection /= 2.0;
            if per_detection < 1.0 {
                return None;
            }
        }
        let nodes = (max_detections * f64::from(per_detection)) as usize + 2;
        let mut tails = vec![[0.0; MAX_COUNT]; nodes];
        let mean = |node: usize| node as f64 / f64::from(per_detection);
        match law.response {
            Response::Binary => {
                for (node, row) in tails.iter_mut().enumerate() {
                    for (cell, tail) in row.iter_mut().zip(law.tails(mean(node))) {
                        *cell = tail;
                    }
                }
            }
            Response::Linear => {
                // P(y > j | k electrons) does not depend on the node.
                let mut readout: Vec<[f64; MAX_COUNT]> = Vec::new();
                for (node, row) in tails.iter_mut().enumerate() {
                    for_each_poisson(mean(node), |k, p| {
                        let k = k as usize;
                        while readout.len() <= k {
                            let electrons = readout.len() as f64;
                            readout.push(std::array::from_fn(|j| {
                                let possible = j < usize::from(law.max_count);
                                if possible { law.exceeds(j, electrons) } else { 0.0 }
                            }));
                        }
                        for (cell, exceeds) in row.iter_mut().zip(&readout[k]) {
                            *cell += p * exceeds;
                        }
                    });
                }
            }
        }
        let threshold = |tail: f64| ((tail * 65536.0).min(65535.0) as u16 ^ 0x8000) as i16;
        let rows = tails
            .iter()
            .map(|tails| {
                let lane = |j: usize| threshold(tails.get(j).copied().unwrap_or(0.0));
                i16x8::new(std::array::from_fn(lane))
            })
            .collect();
        Some(Self { law: law.clone(), nodes_per_detection: per_detection, rows, tails })
    }

    /// Draws one count for each of `scratch.detections`, which are not negative.
    pub(crate) fn draw_row(
        &self,
        scratch: &mut RowScratch,
        counts: &mut [u16],
        rng: &mut impl Rng,
    ) {
        let RowScratch { detections, random, nodes, limits } = scratch;
        random.resize(4 * counts.len(), 0);
        nodes.resize(counts.len(), 0);
        limits.resize(counts.len(), 0);
        rng.fill_bytes(random);
        self.place(detections, nodes, limits);

        let bits = |b: &[u8]| u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let places = nodes.iter().zip(limits.iter());
        for ((count, word), (&node, &limit)) in
            counts.iter_mut().zip(random.chunks_exact(4)).zip(places)
        {
            let bits = bits(word);
            let row = self.rows[node as usize];
            let word = i16x8::splat((bits as u16 ^ 0x8000) as i16);
            let below = word.simd_lt(row).to_bitmask();
            let ties = word.simd_eq(row).to_bitmask();
            // Thresholds fall, so the set lanes are the lowest ones.
            let decided = below.trailing_ones() as u16;
            let open = ties != 0 || (bits >> 16) as u16 <= limit;
            *count = if open { OPEN_COUNT } else { decided };
        }
        for (chunk, counts) in counts.chunks_mut(SCAN_LENGTH).enumerate() {
            // Without a branch per count; most chunks hold no open one.
            if counts.iter().map(|&count| u16::from(count == OPEN_COUNT)).sum::<u16>() == 0 {
                continue;
            }
            for (i, count) in
                counts.iter_mut().enumerate().filter(|(_, count)| **count == OPEN_COUNT)
            {
                let x = chunk * SCAN_LENGTH + i;
                *count = self.draw_open(detections[x], bits(&random[4 * x..]), rng);
            }
        }
    }

    /// Computes the node of each pixel, and the bound of its extra detection.
    fn place(&self, detections: &[f32], nodes: &mut [u32], limits: &mut [u16]) {
        // Adding 2^23 rounds to an integer and leaves it in the low bits; unlike a cast, this is
        // one instruction for a whole vector.
        const ROUNDING_SHIFT: f32 = 8_388_608.0;
        let per_detection = self.nodes_per_detection;
        let scale = 65536.0 / per_detection;
        let last = (self.rows.len() - 1) as f32;
        for ((&mean, node), limit) in detections.iter().zip(nodes).zip(limits) {
            let position = (mean * per_detection).min(last);
            let nearest = (position + ROUNDING_SHIFT) - ROUNDING_SHIFT;
            let floor = if nearest > position { nearest - 1.0 } else { nearest };
            *node = (floor + ROUNDING_SHIFT).to_bits() & 0xffff;
            // 1 - exp(-delta) <= delta: above it, no extra detection for certain. Beyond the table
            // every pixel is left open.
            let bound = if position < last { (position - floor) * scale } else { 65535.0 };
            *limit = (bound + ROUNDING_SHIFT).to_bits() as u16;
        }
    }

    /// Draws a count at `detections` expected, from its 32 bits and as many more as it takes.
    #[cold]
    fn draw_open(&self, detections: f32, bits: u32, rng: &mut impl Rng) -> u16 {
        let position = detections * self.nodes_per_detection;
        let node = position as usize;
        if node >= self.rows.len() - 1 {
            return self.law.draw(f64::from(detections), rng);
        }
        let width = 1.0 / f64::from(self.nodes_per_detection);
        let delta = (f64::from(position) - node as f64) * width;
        let u = (f64::from(bits >> 16) + uniform(rng)) / 65536.0;
        let mut at_least = -(-delta).exp_m1();
        if u >= at_least {
            let u = (f64::from(bits as u16) + uniform(rng)) / 65536.0;
            return self.tails[node].iter().filter(|&&tail| u < tail).count() as u16;
        }
        let (mut extra, mut exactly) = (0, (-delta).exp());
        while u < at_least && extra < 64 {
            extra += 1;
            exactly *= delta / f64::from(extra);
            at_least -= exactly;
        }
        self.law.draw_with_extra(node as f64 * width, extra, rng)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Domain, Streams};
    use crate::sensor::{Gain, Sensor};
    use rand::TryRng;
    use rand::rngs::ChaCha8Rng;
    use std::convert::Infallible;

    /// Draws a count from given bits, as `draw_row` would.
    fn draw(table: &CountTable, detections: f32, bits: u32, rng: &mut ChaCha8Rng) -> u16 {
        let mut words = Given { bits, rest: rng };
        let mut scratch = RowScratch { detections: vec![detections], ..RowScratch::default() };
        let mut count = [0];
        table.draw_row(&mut scratch, &mut count, &mut words);
        count[0]
    }

    /// The first fill yields `bits`; all else is random.
    struct Given<'a> {
        bits: u32,
        rest: &'a mut ChaCha8Rng,
    }

    impl TryRng for Given<'_> {
        type Error = Infallible;

        fn try_next_u32(&mut self) -> Result<u32, Infallible> {
            Ok(self.rest.next_u32())
        }

        fn try_next_u64(&mut self) -> Result<u64, Infallible> {
            Ok(self.rest.next_u64())
        }

        fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), Infallible> {
            bytes.copy_from_slice(&self.bits.to_le_bytes());
            Ok(())
        }
    }

    fn table(bits: u8, read_noise: f64, brightest: f64) -> CountTable {
        let mut sensor = Sensor::load("ideal").unwrap();
        sensor.bits = bits;
        sensor.gain = Gain::Unit;
        sensor.read_noise = read_noise;
        CountTable::new(&CountLaw::new(&sensor, 1.0), brightest).unwrap()
    }

    /// Events far rarer than 2^-16 keep their probability. Conditioning on the 16 bits without
    /// which they cannot happen makes them frequent enough to be counted.
    #[test]
    fn rare_events_keep_their_probability() {
        let mut rng = Streams::new(1).row(Domain::Photons, 0, 0);
        let table = table(3, 0.0, 10.0);
        let trials = 4_000_000;
        // An extra detection of a mean of 1e-9 needs its 16 bits to be 0: 65536e-9 of those.
        let seen =
            (0..trials).filter(|_| draw(&table, 1e-9, 0x0000_8000, &mut rng) > 0).count() as f64;
        let expected = trials as f64 * 65536e-9;
        assert!((seen - expected).abs() < 5.0 * expected.sqrt(), "{seen} {expected}");
        // At a node of mean 1/32, four or more detections have probability 3.9e-8.
        let tail: f64 = table.law.probabilities(1.0 / 32.0)[4..].iter().sum();
        let seen = (0..trials)
            .filter(|_| draw(&table, 1.0 / 32.0, 0xffff_0000, &mut rng) >= 4)
            .count() as f64;
        let expected = trials as f64 * 65536.0 * tail;
        assert!((seen - expected).abs() < 5.0 * expected.sqrt(), "{seen} {expected}");
    }

    /// Averaged over all 16-bit words, the row and its ties give the law to 1e-4 per count.
    #[test]
    fn rows_and_ties_add_up_to_the_law() {
        let mut rng = Streams::new(2).row(Domain::Photons, 0, 0);
        let table = table(3, 0.2, 60.0);
        for lambda in [0.0f32, 0.5, 4.25, 59.0] {
            let mut counts = [0u32; 8];
            for word in 0..=0xffffu32 {
                counts[usize::from(draw(&table, lambda, 0xffff_0000 | word, &mut rng))] += 1;
            }
            let law = table.law.probabilities(f64::from(lambda));
            for (seen, p) in counts.iter().zip(law) {
                assert!((f64::from(*seen) / 65536.0 - p).abs() < 8.0 / 65536.0, "{lambda}");
            }
        }
    }

    #[test]
    fn strong_light_and_deep_samples_need_no_table() {
        let sensor = Sensor::load("ideal").unwrap();
        assert!(CountTable::new(&CountLaw::new(&sensor, 1.0), 10.0).is_none());
        let mut shallow = sensor;
        shallow.bits = 3;
        assert!(CountTable::new(&CountLaw::new(&shallow, 1.0), 1e6).is_none());
        assert!(CountTable::new(&CountLaw::new(&shallow, 1.0), 5000.0).is_some());
    }
}
