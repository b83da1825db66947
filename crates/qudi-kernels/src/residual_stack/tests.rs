//! The fused stack against single convolutions: here on a model of the unit, in `tests/` on the unit.

use super::{Activation, ComputePrecision, MatrixUnits, residual_stack};
use crate::{with_matrix_units, with_precision};
use burn::tensor::{Device, Tensor, TensorData};

fn random<const D: usize>(seed: u64, shape: [usize; D], size: f32, device: &Device) -> Tensor<D> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        ((state >> 40) as f32 / (1u64 << 23) as f32 - 1.0) * size
    };
    let values = (0..shape.iter().product()).map(|_| next()).collect();
    Tensor::from_data(TensorData::new::<f32, _>(values, shape), device)
}

struct Case {
    images: usize,
    size: [usize; 2],
    inputs: Vec<usize>,
    features: usize,
    blocks: usize,
    entry: Activation,
}

/// Output and gradients of all inputs and parameters.
fn run(case: &Case, units: MatrixUnits, bias: f32) -> Vec<Vec<f32>> {
    let device = Device::flex().autodiff();
    let [height, width] = case.size;
    let inputs: Vec<Tensor<4>> = (0..)
        .zip(&case.inputs)
        .map(|(k, &c)| random(k + 1, [case.images, c, height, width], 1.0, &device).require_grad())
        .collect();
    let total: usize = case.inputs.iter().sum();
    let conv = |seed: u64, inputs: usize| {
        let size = (3.0 / (9 * inputs) as f32).sqrt();
        let weight = random(seed, [case.features, inputs, 3, 3], size, &device);
        let bias = random(seed + 1, [case.features], 0.1, &device) + bias;
        (weight.require_grad(), bias.require_grad())
    };
    let mut convolutions = vec![conv(100, total)];
    convolutions.extend((1..=2 * case.blocks as u64).map(|k| conv(100 + 10 * k, case.features)));
    let run = || {
        with_precision(ComputePrecision::Bf16, || {
            residual_stack(&inputs, &convolutions, case.entry)
        })
    };
    let output = with_matrix_units(units, run).unwrap_or_else(|e| panic!("{e}"));
    let weights = random(7, output.dims(), 1.0, &device);
    let gradients =
        with_matrix_units(units, || (output.clone() * weights).sum().backward()).unwrap();
    let values = |x: Tensor<1>| x.into_data().try_into_vec::<f32>().unwrap();
    let gradient = |x: &Tensor<4>| {
        let gradient = x.grad(&gradients).unwrap();
        let count = gradient.shape().num_elements();
        values(gradient.reshape([count]))
    };
    let count = output.shape().num_elements();
    let mut all = vec![values(output.inner().reshape([count]))];
    all.extend(inputs.iter().map(gradient));
    for (weight, bias) in &convolutions {
        all.push(gradient(weight));
        all.push(values(bias.grad(&gradients).unwrap()));
    }
    all
}

/// Several images, odd sizes, inputs that are no multiples of 32, more pixels than a chunk.
#[test]
#[allow(clippy::print_stderr)]
fn fused_stacks_compute_what_single_convolutions_do() {
    let units = [MatrixUnits::Amx, MatrixUnits::Avx512Bf16];
    let available: Vec<_> = units.iter().filter(|units| units.is_available()).collect();
    if available.is_empty() {
        eprintln!("skipped: this machine has no units for bfloat16");
    }
    let case = |images, size, inputs: &[usize], features, blocks, entry| Case {
        images,
        size,
        inputs: inputs.to_vec(),
        features,
        blocks,
        entry,
    };
    let cases = [
        case(1, [1, 1], &[3], 32, 0, Activation::Relu),
        case(3, [5, 7], &[9, 32, 2], 32, 1, Activation::Relu),
        case(2, [16, 33], &[32], 64, 2, Activation::None),
        case(1, [30, 41], &[1, 2, 3, 4, 5, 6, 7, 8], 32, 1, Activation::Relu),
        case(2, [6, 9], &[40], 32, 0, Activation::None),
        // As above, with ReLU: the entry's gradient is another one.
        case(2, [16, 33], &[32], 64, 2, Activation::Relu),
        // Images of several groups.
        case(3, [30, 41], &[32], 32, 1, Activation::None),
    ];
    for case in cases {
        // Activations have 8 bits, and ReLUs of tiny sums turn: fewer do where most are above zero.
        for (bias, tolerance) in [(0.0, 0.08), (6.0, 0.03)] {
            let single = run(&case, MatrixUnits::F32, bias);
            for &units in &available {
                let fused = run(&case, *units, bias);
                assert_eq!(fused.len(), single.len());
                let is_compiled = cfg!(feature = "flex") && case.blocks > 0;
                assert!(!is_compiled || fused != single, "{units}: nothing is fused");
                for (number, (fused, single)) in fused.iter().zip(&single).enumerate() {
                    let share = difference(fused, single);
                    let what = format!("{units}, {:?}, bias {bias}, {number}", case.size);
                    assert!(share < tolerance, "{what}: {share}");
                }
            }
        }
    }
}

/// Root mean square of the differences, as a share of the values'.
fn difference(values: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(values.len(), expected.len());
    let size = expected.iter().map(|v| v * v).sum::<f32>();
    let error = values.iter().zip(expected).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    (error / size).sqrt()
}
