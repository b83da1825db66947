//! Initial weights, as the authors' programs start, by the names of parameters in files.

use crate::method::Sizes;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

/// Law of a parameter's initial values.
#[derive(Clone, Debug)]
pub(crate) enum Law {
    /// One value.
    Same(f32),
    /// These values, row-major.
    These(Vec<f32>),
    /// Uniform with this standard deviation.
    Random(f32),
}

/// Draws the initial values of a parameter, by its name in files and its shape. `of_weight` is the shape of
/// the weight that a bias belongs to.
///
/// Where authors draw from a normal law, values are uniform with the same variance.
pub(super) fn initial_values(
    sizes: Sizes,
    seed: u64,
    name: &str,
    shape: &[usize],
    of_weight: Option<&[usize]>,
) -> Vec<f32> {
    let count = shape.iter().product();
    match sizes.initial_law(name, shape).unwrap_or_else(|| usual(name, shape, of_weight)) {
        Law::Same(value) => vec![value; count],
        Law::These(values) => values,
        Law::Random(deviation) => {
            // A stream of its own for every name: another part leaves these values as they are.
            let hash = name.bytes().fold(0xCBF2_9CE4_8422_2325, |hash: u64, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3) // FNV-1a
            });
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(hash);
            let bound = deviation * 3f32.sqrt();
            (0..count).map(|_| random.random_range(-bound..bound)).collect()
        }
    }
}

/// Returns PyTorch's law: norms start as the identity, other layers uniformly within `1 / sqrt(inputs)`.
fn usual(name: &str, shape: &[usize], of_weight: Option<&[usize]>) -> Law {
    if name.ends_with(".running_var") || (name.ends_with(".weight") && shape.len() == 1) {
        return Law::Same(1.0);
    }
    let weight = of_weight.unwrap_or(shape);
    if weight.len() < 2 {
        // Of a norm, or a running mean.
        return Law::Same(0.0);
    }
    let inputs: usize = weight[1..].iter().product();
    Law::Random((1.0 / (3.0 * inputs as f32)).sqrt())
}

/// Returns the law of He et al. (ICCV 2015) for layers before a ReLU, times `scale`.
pub(crate) fn kaiming(scale: f32, shape: &[usize]) -> Law {
    let inputs = shape[1..].iter().product::<usize>() as f32;
    Law::Random(scale * (2.0 / inputs).sqrt())
}

/// Returns true if a name ends with one of `ends`.
pub(crate) fn ends_with_any(name: &str, ends: &[&str]) -> bool {
    ends.iter().any(|end| name.ends_with(end))
}
