//! Names of parameters, former and present, and their initial values.

use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

/// Parts of parameter names, and what they were called in weight files of version 0.1.
const FORMER_PARTS: [(&str, &str); 4] = [
    ("stages", "drafts"),
    ("uncertainty", "error"),
    ("weighting", "trust"),
    ("weighted_in", "trusted_in"),
];

/// The former name of a parameter, by which older weight files and golden values know it.
pub fn former_name(name: &str) -> String {
    let former = |part: &str| {
        let found = FORMER_PARTS.iter().find(|(now, _)| *now == part);
        found.map_or(part, |(_, former)| *former).to_owned()
    };
    name.split('.').map(former).collect::<Vec<_>>().join(".")
}

/// The last layers of residual branches, which start at zero.
const ZERO_AT_FIRST: [&str; 7] = [
    "conv2.weight",
    "project.weight",
    "unet.out.weight",
    "pre.out.weight",
    "weighting.out.weight",
    "uncertainty.out.weight",
    "layers.4.weight",
];

/// Initial values: uniform with the variance that keeps the size of signals through a ReLU (He et al. 2015)
/// or a plain layer. The last layer of every residual branch starts at zero: so a deep network starts as its
/// shortcuts.
pub(super) fn initial_values(seed: u64, name: &str, shape: &[usize]) -> Vec<f32> {
    let count: usize = shape.iter().product();
    if shape.len() == 1 {
        let is_norm = name.ends_with(".weight");
        return vec![if is_norm { 1.0 } else { 0.0 }; count];
    }
    let stage_out = name.starts_with("stages.") && name.ends_with(".out.weight");
    if stage_out || ZERO_AT_FIRST.iter().any(|last| name.ends_with(last)) {
        return vec![0.0; count];
    }
    let gain = if name.starts_with("unet.") { 3.0 } else { 6.0 };
    let bound = (gain / (count / shape[0]) as f32).sqrt();
    // A stream of its own for every name: adding a layer leaves the others as they were. Former names keep
    // former initial values.
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(former_name(name).bytes().fold(0xCBF2_9CE4_8422_2325, |hash: u64, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3) // FNV-1a
    }));
    (0..count).map(|_| random.random_range(-bound..bound)).collect()
}
