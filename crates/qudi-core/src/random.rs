//! Random numbers that do not depend on threads: one ChaCha8 stream per (seed, purpose, frame, row).

use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};

/// Purpose of a stream; streams of different purposes are independent.
#[derive(Clone, Copy, Debug)]
pub enum Domain {
    /// Detections and read noise.
    Photons = 0,
    /// Cross-talk and afterpulses.
    Echoes = 1,
    /// The fixed pattern of a camera's pixels.
    Pattern = 2,
    /// The layout of a procedural scene.
    Scene = 3,
    /// Random draws of training.
    Training = 4,
}

/// Rows per frame that have streams of their own (2^24); frames get the 38 bits above them.
const ROW_BITS: u32 = 24;
const FRAME_BITS: u32 = 38;

/// All streams of one seed.
#[derive(Clone, Debug)]
pub struct Streams {
    key: [u8; 32],
}

impl Streams {
    /// Creates the streams of `seed`.
    pub fn new(seed: u64) -> Self {
        Self { key: ChaCha8Rng::seed_from_u64(seed).get_seed() }
    }

    /// Returns the stream of row `y` of frame `frame`.
    pub fn row(&self, domain: Domain, frame: u64, y: usize) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::from_seed(self.key);
        let frame = frame & ((1 << FRAME_BITS) - 1);
        rng.set_stream((domain as u64) << (FRAME_BITS + ROW_BITS) | frame << ROW_BITS | y as u64);
        rng
    }
}

/// Draws a uniform number in [0, 1) with 53 bits.
pub fn uniform(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}
