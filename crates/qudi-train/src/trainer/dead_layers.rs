//! Layers that have stopped learning: where all rectified units before or after a layer are zero for every
//! input, no gradient reaches it, and no later step wakes it.

use burn::tensor::Tensor;
use qudi_core::Result;
use qudi_kernels::is_flex;
use qudi_layers::tensor::read;
use rayon::prelude::*;
use std::collections::HashMap;

/// The largest mean gradient of a dead layer, over the largest of its part: after some hundred steps without
/// gradient the running mean is below it.
const NONE: f32 = 1e-9;

/// The steps after which layers are judged: what lies before layers that begin at zero has no gradient in the
/// first ones.
pub(super) const FIRST_STEPS: u64 = 10;

/// Returns the names of the layers whose weights no gradient reaches, in the order of the network. Parts of a
/// network (what names begin with) that no gradient reaches at all are left out: the recipe gives them
/// nothing to learn from.
///
/// `means` are the running means of the gradients of all parameters, which `names` names; `learns` says
/// which of them can learn.
///
/// # Errors
/// [`Error`](qudi_core::Error) if the device fails.
pub(super) fn dead_layers(
    names: &[String],
    means: &[Tensor<1>],
    learns: &[bool],
) -> Result<Vec<String>> {
    let largest = |mean: &Tensor<1>| mean.clone().abs().max();
    let largest: Vec<Tensor<1>> = if means.first().is_some_and(|mean| is_flex(&mean.device())) {
        means.par_iter().map(largest).collect()
    } else {
        means.iter().map(largest).collect()
    };
    let largest = read(Tensor::cat(largest, 0))?;
    let layers: Vec<(&str, f32)> = (0..names.len())
        .filter(|&at| learns[at])
        .filter_map(|at| Some((names[at].strip_suffix(".weight")?, largest[at])))
        .collect();
    let mut of_parts: HashMap<&str, f32> = HashMap::new();
    for &(name, largest) in &layers {
        let of_part = of_parts.entry(part(name)).or_default();
        *of_part = of_part.max(largest);
    }
    let is_dead = |(name, largest): &&(&str, f32)| {
        let of_part = of_parts[part(name)];
        of_part > f32::MIN_POSITIVE / NONE && *largest <= NONE * of_part
    };
    Ok(layers.iter().filter(is_dead).map(|(name, _)| (*name).to_owned()).collect())
}

/// Returns the part of the network that a layer belongs to.
fn part(name: &str) -> &str {
    name.split('.').next().unwrap_or(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn layers_without_gradient_are_named_and_idle_parts_are_not() {
        let device = Device::flex();
        let layers: [(&str, [f32; 2], bool); 9] = [
            ("unet.enter.weight", [0.0, -2.0], true),
            ("unet.enter.bias", [0.0, 0.0], true),
            ("unet.out.weight", [0.0, 0.0], true),
            ("unet.last.weight", [0.0, 1e-9], true),
            ("unet.frozen.weight", [0.0, 0.0], false),
            ("flow.first.weight", [0.0, 0.0], true),
            ("fusion.first.weight", [1e-6, 0.0], true),
            // A part that learns seldom has small means, and none that is dead.
            ("gate.first.weight", [1e-12, 0.0], true),
            ("gate.last.weight", [1e-15, 0.0], true),
        ];
        let names: Vec<String> = layers.iter().map(|(name, ..)| (*name).to_owned()).collect();
        let means: Vec<_> =
            layers.iter().map(|(_, mean, _)| Tensor::from_floats(*mean, &device)).collect();
        let learns: Vec<bool> = layers.iter().map(|(.., learns)| *learns).collect();
        let dead = dead_layers(&names, &means, &learns).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(dead, ["unet.out", "unet.last"]);
    }
}
