//! Layers that have stopped learning: where all rectified units before or after a layer are zero for every
//! input, no gradient reaches it, and no later step wakes it.

use burn::tensor::Tensor;
use qudi_core::Result;
use qudi_kernels::is_flex;
use qudi_layers::tensor::read;
use rayon::prelude::*;

/// The largest mean gradient of a dead layer, over the largest of all layers: after some hundred steps
/// without gradient the running mean is below it.
const NONE: f32 = 1e-9;

/// Returns the names of the layers whose weights no gradient reaches, in the order of the network. Parts of a
/// network (what names begin with) that no gradient reaches at all are left out: the recipe gives them
/// nothing to learn from.
///
/// `means` are the running means of the gradients of all parameters, which `names` names; `learns` says
/// which of them learn.
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
    let bound = NONE * largest.iter().copied().fold(0.0, f32::max);
    let has_gradient = |at: usize| learns[at] && largest[at] > bound;
    let part = |name: &str| name.split('.').next().map(str::to_owned);
    let of_layers = || names.iter().enumerate().filter(|(_, name)| name.ends_with(".weight"));
    let learning: Vec<_> =
        of_layers().filter(|(at, _)| has_gradient(*at)).map(|(_, name)| part(name)).collect();
    let is_dead =
        |at: usize, name: &str| learns[at] && !has_gradient(at) && learning.contains(&part(name));
    let dead = of_layers().filter(|(at, name)| is_dead(*at, name));
    Ok(dead.map(|(_, name)| name.trim_end_matches(".weight").to_owned()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn layers_without_gradient_are_named_and_idle_parts_are_not() {
        let device = Device::flex();
        let layers: [(&str, [f32; 2], bool); 7] = [
            ("unet.enter.weight", [0.0, -2.0], true),
            ("unet.enter.bias", [0.0, 0.0], true),
            ("unet.out.weight", [0.0, 0.0], true),
            ("unet.last.weight", [0.0, 1e-9], true),
            ("unet.frozen.weight", [0.0, 0.0], false),
            ("flow.first.weight", [0.0, 0.0], true),
            ("fusion.first.weight", [1e-6, 0.0], true),
        ];
        let names: Vec<String> = layers.iter().map(|(name, ..)| (*name).to_owned()).collect();
        let means: Vec<_> =
            layers.iter().map(|(_, mean, _)| Tensor::from_floats(*mean, &device)).collect();
        let learns: Vec<bool> = layers.iter().map(|(.., learns)| *learns).collect();
        let dead = dead_layers(&names, &means, &learns).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(dead, ["unet.out", "unet.last"]);
    }
}
