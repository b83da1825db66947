//! The fast exact path for shallow samples: one 32-bit random number and one table row per count.
//!
//! A Poisson number of mean `lambda = node + delta` is one of mean `node` plus one of mean `delta`
//! (superposition). `delta` is small, so its part is nearly always 0, and the count then follows
//! the tabulated law of the node. The upper 16 random bits decide about `delta`, the lower 16 pick
//! the count. Where 16 bits leave the answer open (a tie, about 1 in 10^4), more are drawn, so
//! the result has the exact law, not one rounded to 16 bits. This holds for binary sums too: the
//! extra photon falls into one of the summed frames.

use super::CountLaw;
use crate::random::uniform;
use rand::Rng;

/// Counts up to 7 (3 bits): a row of eight 16-bit thresholds fills one SIMD register.
const MAX_COUNT: usize = 7;
const LANES: usize = MAX_COUNT + 1;

/// Most rows of a table; beyond, nodes move apart (and `delta` draws get more frequent).
const MAX_ROWS: f64 = 8192.0;
const NODES_PER_DETECTION: f64 = 32.0;

/// Tabulated laws of a count over a range of expected detections.
#[derive(Clone, Debug)]
pub(crate) struct CountTable {
    law: CountLaw,
    nodes_per_detection: f32,
    /// `65536 * delta` per fraction of a node's width.
    extra_scale: f32,
    /// `floor(65536 * P(y > j))`.
    rows: Vec<[u16; LANES]>,
    /// `P(y > j)`.
    tails: Vec<[f64; MAX_COUNT]>,
}

impl CountTable {
    /// A table for means up to `max_detections`, or none if the samples are too deep, the light too
    /// strong, or arrivals not independent (dead time): then counts are drawn directly.
    pub(crate) fn new(law: &CountLaw, max_detections: f64) -> Option<Self> {
        if usize::from(law.max_count) > MAX_COUNT || law.dead_time > 0.0 {
            return None;
        }
        // Powers of two keep `lambda - node` exact in f32.
        let mut per_detection = NODES_PER_DETECTION;
        while max_detections * per_detection >= MAX_ROWS {
            per_detection /= 2.0;
            if per_detection < 1.0 {
                return None;
            }
        }
        let nodes = (max_detections * per_detection) as usize + 2;
        let mut table = Self {
            law: law.clone(),
            nodes_per_detection: per_detection as f32,
            extra_scale: (65536.0 / per_detection) as f32,
            rows: Vec::with_capacity(nodes),
            tails: Vec::with_capacity(nodes),
        };
        for node in 0..nodes {
            let exact = law.tails(node as f64 / per_detection);
            let (mut row, mut tails) = ([0; LANES], [0.0; MAX_COUNT]);
            for (j, &tail) in exact.iter().enumerate() {
                tails[j] = tail;
                row[j] = (tail * 65536.0).min(65535.0) as u16;
            }
            table.rows.push(row);
            table.tails.push(tails);
        }
        Some(table)
    }

    /// A count at `detections >= 0` expected; `bits` are 32 fresh random bits, `rng` gives more.
    #[inline]
    pub(crate) fn draw(&self, detections: f32, bits: u32, rng: &mut impl Rng) -> u16 {
        let position = detections * self.nodes_per_detection;
        let node = position as usize;
        let Some(row) = self.rows.get(node) else {
            return self.law.draw(f64::from(detections), rng);
        };
        let (for_extra, for_count) = (bits >> 16, bits as u16);
        let fraction = position - node as f32;
        // 1 - exp(-delta) <= delta: above it, no extra detection for certain.
        if (for_extra as f32) <= fraction * self.extra_scale {
            return self.draw_between(node, fraction, bits, rng);
        }
        let (mut count, mut ties) = (0u16, 0u16);
        for &threshold in row {
            count += u16::from(for_count < threshold);
            ties += u16::from(for_count == threshold);
        }
        if ties == 0 { count } else { self.resolve(node, for_count, rng) }
    }

    /// The rare case in which an extra detection is possible.
    #[cold]
    fn draw_between(&self, node: usize, fraction: f32, bits: u32, rng: &mut impl Rng) -> u16 {
        let width = 1.0 / f64::from(self.nodes_per_detection);
        let delta = f64::from(fraction) * width;
        let u = (f64::from(bits >> 16) + uniform(rng)) / 65536.0;
        let mut at_least = -(-delta).exp_m1();
        if u >= at_least {
            return self.resolve(node, bits as u16, rng);
        }
        let (mut extra, mut exactly) = (0, (-delta).exp());
        while u < at_least && extra < 64 {
            extra += 1;
            exactly *= delta / f64::from(extra);
            at_least -= exactly;
        }
        self.law.draw_with_extra(node as f64 * width, extra, rng)
    }

    /// Picks the count with as many bits as it takes.
    #[cold]
    fn resolve(&self, node: usize, for_count: u16, rng: &mut impl Rng) -> u16 {
        let u = (f64::from(for_count) + uniform(rng)) / 65536.0;
        self.tails[node].iter().filter(|&&tail| u < tail).count() as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Domain, Streams};
    use crate::sensor::{Gain, Sensor};

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
            (0..trials).filter(|_| table.draw(1e-9, 0x0000_8000, &mut rng) > 0).count() as f64;
        let expected = trials as f64 * 65536e-9;
        assert!((seen - expected).abs() < 5.0 * expected.sqrt(), "{seen} {expected}");
        // At a node of mean 1/32, four or more detections have probability 3.9e-8.
        let tail: f64 = table.law.probabilities(1.0 / 32.0)[4..].iter().sum();
        let seen = (0..trials)
            .filter(|_| table.draw(1.0 / 32.0, 0xffff_0000, &mut rng) >= 4)
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
                counts[usize::from(table.draw(lambda, 0xffff_0000 | word, &mut rng))] += 1;
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
