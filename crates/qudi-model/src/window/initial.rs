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

/// Returns the prefix and the values of a parameter of a module that older weights lack. With these values the
/// formula of `agreement` alone weights neighbours, and the U-Net does not start from merged frames.
pub(crate) fn added_later(name: &str, shape: &[usize]) -> Option<(&'static str, Vec<f32>)> {
    const MODULES: [&str; 2] = ["agreement.", "unet.gate."];
    /// Closes the gate.
    const CLOSED: f32 = -20.0;
    let module = MODULES.into_iter().find(|module| name.starts_with(module))?;
    let mut values = initial_values(1, name, shape);
    match name {
        "unet.gate.bias" => values.fill(CLOSED),
        "unet.gate.weight" => values.fill(0.0),
        _ if name.ends_with("out.weight") => values.fill(0.0),
        _ => {}
    }
    Some((module, values))
}
