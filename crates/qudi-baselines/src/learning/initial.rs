//! Initial weights, as the authors' programs start, by the names of parameters in files.

use crate::sizes::Sizes;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::f32::consts::FRAC_1_SQRT_2;

/// The colour transform of EMVD: four orthonormal rows.
const COLOURS: [[f32; 4]; 4] = [
    [0.5, 0.5, 0.5, 0.5],
    [-0.5, 0.5, 0.5, -0.5],
    [0.65, 0.2784, -0.2784, -0.65],
    [-0.2784, 0.65, -0.65, 0.2784],
];

/// How much smaller the weights of residual blocks start than signals keep their size with.
const FLORNN_SHARE: f32 = 0.2;
const MEMDEBLUR_SHARE: f32 = 0.1;

/// The standard deviation of what attention starts with.
const ATTENTION: f32 = 0.02;

/// What a parameter starts with.
enum Law {
    /// One value.
    Same(f32),
    /// These values, row-major.
    These(Vec<f32>),
    /// Uniform with this standard deviation.
    Random(f32),
}

/// The initial values of a parameter, by its name in files and its shape. `of_weight` is the shape of the weight that
/// a bias belongs to.
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
    match special(sizes, name, shape).unwrap_or_else(|| usual(name, shape, of_weight)) {
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

/// What layers of PyTorch start with: norms as the identity, others uniform within `1 / sqrt(inputs)`.
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

/// What authors start otherwise.
fn special(sizes: Sizes, name: &str, shape: &[usize]) -> Option<Law> {
    let inputs = || shape[1..].iter().product::<usize>() as f32;
    // Of He et al. (ICCV 2015), for ReLU.
    let kaiming = |share: f32| Law::Random(share * (2.0 / inputs()).sqrt());
    let is_weight = name.ends_with(".weight");
    let ends = |list: &[&str]| list.iter().any(|end| name.ends_with(end));
    match sizes {
        Sizes::Emvd(_) => {
            let s = FRAC_1_SQRT_2;
            let at = |place: usize| (place / 4, place % 4);
            match name {
                "ct.net1.weight" => Some(Law::These(COLOURS.concat())),
                "cti.net1.weight" => {
                    let turned = (0..16).map(at).map(|(row, column)| COLOURS[column][row]);
                    Some(Law::These(turned.collect()))
                }
                "ft.net1.weight" => Some(Law::These(vec![s, s, s, -s])),
                "fti.net1.weight" => Some(Law::These(vec![s, s])),
                "fti.net2.weight" => Some(Law::These(vec![s, -s])),
                _ => None,
            }
        }
        Sizes::Quiver(_) => {
            let zero = ["pa_deform.bias", "conv_offset.6.weight", "conv_offset.6.bias"];
            ends(&zero).then_some(Law::Same(0.0))
        }
        Sizes::Spk2ImgNet(_) if ends(&["prelu0.weight", "prelu1.weight"]) => Some(Law::Same(0.25)),
        Sizes::Spk2ImgNet(_) => {
            let zero =
                name.contains(".conv_offset_mask.") || ends(&["dcnpack_1.bias", "dcnpack.bias"]);
            zero.then_some(Law::Same(0.0))
        }
        Sizes::FloRnn(_) => is_weight.then(|| kaiming(FLORNN_SHARE)),
        Sizes::MemDeblur(_) => {
            let convolution = ends(&["conv1.weight", "conv2.weight", "conv1.bias", "conv2.bias"]);
            let residual = convolution && name.contains("resblocks.");
            residual.then(|| if is_weight { kaiming(MEMDEBLUR_SHARE) } else { Law::Same(0.0) })
        }
        Sizes::Rvrt(_) => {
            let linear = ["qkv_self", "attn.proj", "mlp.fc1", "mlp.fc2", "linear"];
            let is_linear = linear.iter().any(|layer| name.contains(&format!("{layer}.")));
            if name.contains("conv_offset.10.") || (is_linear && !is_weight) {
                Some(Law::Same(0.0))
            } else {
                let attention = is_linear || name.ends_with("relative_position_bias_table");
                attention.then_some(Law::Random(ATTENTION))
            }
        }
        Sizes::StudentTeacher(sizes) => {
            // The mean of all frames.
            let taps = sizes.kernel * sizes.kernel;
            let centre = |place: usize| if place % taps == taps / 2 { 1.0 } else { 0.0 };
            name.ends_with("kernels.bias").then(|| Law::These((0..shape[0]).map(centre).collect()))
        }
    }
}
