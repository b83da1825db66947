//! Initial values of parameters.

use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

/// The last layers of residual branches, which start at zero.
const ZERO_LAYERS: [&str; 8] = [
    "conv2.weight",
    "project.weight",
    "unet.out.weight",
    "pre.out.weight",
    "refinement.out.weight",
    "weighting.out.weight",
    "uncertainty.out.weight",
    "layers.4.weight",
];

/// Draws initial values: uniform with the variance that keeps the size of signals through a ReLU (He et al.
/// 2015) or a plain layer. The last layer of every residual branch starts at zero: so a deep network starts
/// as its shortcuts.
pub(crate) fn initial_values(seed: u64, name: &str, shape: &[usize]) -> Vec<f32> {
    let count: usize = shape.iter().product();
    if shape.len() == 1 {
        let is_norm = name.ends_with(".weight");
        return vec![if is_norm { 1.0 } else { 0.0 }; count];
    }
    if ZERO_LAYERS.iter().any(|last| name.ends_with(last)) {
        return vec![0.0; count];
    }
    let gain = if name.starts_with("unet.") { 3.0 } else { 6.0 };
    uniform(seed, name, count, (gain / (count / shape[0]) as f32).sqrt())
}

/// Draws `count` values between `-bound` and `bound` for the parameter `name`.
pub(crate) fn uniform(seed: u64, name: &str, count: usize, bound: f32) -> Vec<f32> {
    // A stream of its own for every name: adding a layer leaves the others as they were.
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(name.bytes().fold(0xCBF2_9CE4_8422_2325, |hash: u64, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3) // FNV-1a
    }));
    (0..count).map(|_| random.random_range(-bound..bound)).collect()
}
