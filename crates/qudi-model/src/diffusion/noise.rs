//! The diffusion's noise: a stream of its own for every (seed, sample, frame, step), so that all devices,
//! tiles and windows draw the same.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Steps that have streams of their own.
const STEP_BITS: u32 = 16;

/// Streams of one sample.
#[derive(Clone, Debug)]
pub struct Noise {
    key: [u8; 32],
}

impl Noise {
    /// Sample `sample` of `seed`.
    pub fn new(seed: u64, sample: u64) -> Self {
        let mut key = ChaCha8Rng::seed_from_u64(seed).get_seed();
        for (byte, other) in key.iter_mut().zip(ChaCha8Rng::seed_from_u64(!sample).get_seed()) {
            *byte ^= other;
        }
        Self { key }
    }

    /// Standard normal values for frame `frame` of the capture; step 0 is the start.
    pub fn frame(&self, frame: u64, step: usize, pixels: usize) -> impl Iterator<Item = f32> {
        let mut random = ChaCha8Rng::from_seed(self.key);
        random.set_stream(frame << STEP_BITS | step as u64 & ((1 << STEP_BITS) - 1));
        (0..pixels).map(move |_| StandardNormal.sample(&mut random))
    }

    /// Returns a seed for the photons of step `step`.
    pub fn photon_seed(&self, step: usize) -> u64 {
        let mut seed = [0; 8];
        seed.copy_from_slice(&self.key[..8]);
        u64::from_le_bytes(seed) ^ (step as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_normal_and_streams_differ() {
        let noise = Noise::new(3, 0);
        let values: Vec<f32> = noise.frame(5, 0, 100_000).collect();
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / 1e5;
        let square = values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>() / 1e5;
        assert!(mean.abs() < 0.013 && (square - 1.0).abs() < 0.018, "mean {mean}, square {square}");
        let first = |seed, sample, frame, step| {
            Noise::new(seed, sample).frame(frame, step, 1).next().unwrap_or_default()
        };
        let all = [
            first(3, 0, 5, 0),
            first(4, 0, 5, 0),
            first(3, 1, 5, 0),
            first(3, 0, 6, 0),
            first(3, 0, 5, 1),
        ];
        for (i, a) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|b| a != b), "streams {i} repeats another");
        }
        assert_eq!(values[0], first(3, 0, 5, 0));
    }
}
