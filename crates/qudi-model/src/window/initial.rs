//! Initial values of parameters.

use crate::initial::uniform;

/// The scale of the last convolutions of residual blocks, of image heads, gates and corrections: small, but
/// not zero, since steps along orthogonal matrices (Muon) have full size whatever the gradient behind a zero.
const SCALES: [(&str, f32); 4] = [
    ("second.weight", 0.3),
    ("head.out.weight", 0.1),
    ("unet.gate.weight", 0.1),
    ("out.weight", 0.02),
];

/// Draws initial values: uniform with the variance that keeps the size of signals through a ReLU (He et al.
/// 2015). Biases start at zero.
pub(super) fn initial_values(seed: u64, name: &str, shape: &[usize]) -> Vec<f32> {
    let count: usize = shape.iter().product();
    if shape.len() == 1 {
        return vec![0.0; count];
    }
    let scale = SCALES.iter().find(|(last, _)| name.ends_with(last)).map_or(1.0, |(_, s)| *s);
    let bound = scale * (6.0 / (count / shape[0]) as f32).sqrt();
    uniform(seed, name, count, bound)
}
