//! Reduced precision compared with single precision on numbers rounded by hand, on every unit of the machine.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/golden/cases.rs"]
mod cases;

use burn::tensor::{Device, Tensor, TensorData, bf16};
use cases::uniform;
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::{
    ComputePrecision, MatrixUnits, MatrixUnitsError, with_matrix_units, with_precision,
    with_stock_operations,
};

const IMAGES: [usize; 4] = [4, 3, 10, 13];
const OUTPUTS: usize = 5;

fn round(x: f32) -> f32 {
    bf16::from_f32(x).to_f32()
}

fn tensor<const D: usize>(shape: [usize; D], seed: usize, device: &Device) -> Tensor<D> {
    let values = uniform(&format!("precision {seed}"), shape.iter().product());
    let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn rounded<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let values: Vec<f32> = list(x.clone()).into_iter().map(round).collect();
    Tensor::from_data(TensorData::new(values, x.dims()), &x.device())
}

fn list<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_to_vec().unwrap()
}

/// Returns the result, and the gradients of input, weight, bias and addend for `cotangent`.
fn run(
    [x, addend, cotangent]: [Tensor<4>; 3],
    weight: Tensor<5>,
    bias: Tensor<1>,
    stride: usize,
) -> [Vec<f32>; 5] {
    let (x, addend) = (x.require_grad(), addend.require_grad());
    let (weight, bias) = (weight.require_grad(), bias.require_grad());
    let activation = Activation::None;
    let options = Options { stride, addend: Some(addend.clone()), activation };
    let [outputs, channels, frames, rows, columns] = weight.dims();
    let output = if frames == 1 {
        let weight = weight.clone().reshape([outputs, channels, rows, columns]);
        conv_2d(std::slice::from_ref(&x), weight, bias.clone(), options)
    } else {
        conv_3d(std::slice::from_ref(&x), weight.clone(), bias.clone(), 2, options)
    };
    let grads = (output.clone() * cotangent).sum().backward();
    [
        list(output.inner()),
        list(x.grad(&grads).unwrap()),
        list(weight.grad(&grads).unwrap()),
        list(bias.grad(&grads).unwrap()),
        list(addend.grad(&grads).unwrap()),
    ]
}

fn each_unit(run: impl Fn(MatrixUnits)) {
    for units in [MatrixUnits::F32, MatrixUnits::Avx512Bf16, MatrixUnits::Amx] {
        let ran = with_matrix_units(units, || run(units));
        // Units that this machine lacks cannot be tested on it; all have the plain one.
        assert!(ran.is_ok() || units != MatrixUnits::F32, "nothing was tested");
    }
}

/// Asserts equality. Without matrix units the values are identical; with them, sums have another order.
fn assert_same(units: MatrixUnits, got: &[f32], expected: &[f32], about: &str) {
    let scale = expected.iter().fold(1e-3f32, |scale, value| scale.max(value.abs()));
    let allowed = if units == MatrixUnits::F32 { 0.0 } else { 3e-6 * scale };
    assert_eq!(got.len(), expected.len(), "{about}");
    for (got, expected) in got.iter().zip(expected) {
        assert!((got - expected).abs() <= allowed, "{got} and {expected}: {units}, {about}");
    }
}

/// Checks that products take rounded numbers and sum in 32 bits, and that bias and addend are not rounded.
/// The same holds for gradients in the backward pass.
#[test]
fn bf16_rounds_products_only() {
    let device = Device::flex().autodiff();
    let kernels = [([1, 3, 3], 1), ([1, 3, 3], 2), ([1, 1, 1], 1), ([3, 5, 5], 1)];
    each_unit(|units| {
        for (kernel, stride) in kernels {
            let [frames, rows, columns] = kernel;
            let x = tensor(IMAGES, 1, &device);
            let weight = tensor([OUTPUTS, IMAGES[1], frames, rows, columns], 2, &device);
            let bias = tensor([OUTPUTS], 3, &device);
            let grid = [IMAGES[0], OUTPUTS, IMAGES[2].div_ceil(stride), IMAGES[3].div_ceil(stride)];
            let (addend, cotangent) = (tensor(grid, 4, &device), tensor(grid, 5, &device));
            let got = with_precision(ComputePrecision::Bf16, || {
                let images = [x.clone(), addend.clone(), cotangent.clone()];
                run(images, weight.clone(), bias.clone(), stride)
            });
            let images = [rounded(x), addend, rounded(cotangent.clone())];
            let [sum, of_x, of_weight, ..] = run(images, rounded(weight), bias, stride);
            let cotangent = list(cotangent);
            let mut of_bias = vec![0.0; OUTPUTS];
            for (place, value) in cotangent.iter().enumerate() {
                of_bias[place / (grid[2] * grid[3]) % OUTPUTS] += value;
            }
            let about = format!("{kernel:?}, {stride}");
            assert_same(units, &got[0], &sum, &about);
            assert_same(units, &got[1], &of_x, &about);
            assert_same(units, &got[2], &of_weight, &about);
            for (got, expected) in got[3].iter().zip(of_bias) {
                assert!((got - expected).abs() < 1e-4, "{got} and {expected}: {about}");
            }
            assert_eq!(got[4], cotangent, "{about}");
        }
    });
}

/// Checks that all units agree on shapes that fill no block, with any number of threads.
#[test]
fn units_agree_on_any_shape() {
    let device = Device::flex().autodiff();
    let mut draws = uniform("shapes", 200).into_iter().map(|value| f64::midpoint(value, 1.0));
    let mut draw = |from: usize, to: usize| {
        from + (draws.next().unwrap() * (to - from + 1) as f64).min((to - from) as f64) as usize
    };
    for case in 0..12 {
        let size = 2 * draw(0, 3) + 1;
        let (frames, stride) = ([1, 1, 3][draw(0, 2)], draw(1, 2));
        let [images, channels, height, width] = [2, draw(1, 50), draw(1, 40), draw(1, 70)];
        let outputs = draw(1, 50);
        let x = tensor([images, channels, height, width], 10 + case, &device);
        let weight = tensor([outputs, channels, frames, size, size], 30 + case, &device);
        let bias = tensor([outputs], 50 + case, &device);
        let grid = [images, outputs, height.div_ceil(stride), width.div_ceil(stride)];
        let (addend, cotangent) =
            (tensor(grid, 70 + case, &device), tensor(grid, 90 + case, &device));
        let compute = |units, threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let images = [x.clone(), addend.clone(), cotangent.clone()];
            pool.install(|| {
                with_matrix_units(units, || {
                    with_precision(ComputePrecision::Bf16, || {
                        run(images, weight.clone(), bias.clone(), stride)
                    })
                })
            })
        };
        let expected = compute(MatrixUnits::F32, 1).unwrap();
        let about = format!("{:?} by {:?}, {stride}", x.dims(), weight.dims());
        for units in [MatrixUnits::F32, MatrixUnits::Avx512Bf16, MatrixUnits::Amx] {
            let Ok(one) = compute(units, 1) else { continue };
            assert_eq!(one, compute(units, 3).unwrap(), "one thread and three, {units}: {about}");
            for (got, expected) in one.iter().zip(&expected) {
                assert_same(units, got, expected, &about);
            }
        }
    }
}

/// Checks that missing units are refused with an error.
#[test]
fn missing_units_are_refused() {
    for units in [MatrixUnits::Avx512Bf16, MatrixUnits::Amx] {
        match with_matrix_units(units, || ()) {
            Ok(()) => assert!(units.is_available()),
            Err(error) => {
                assert_eq!(error, MatrixUnitsError::Unavailable(units));
                assert!(error.to_string().contains(&units.to_string()), "{error}");
            }
        }
    }
    assert!("avx".parse::<MatrixUnits>().unwrap_err().to_string().contains("avx"));
    assert_eq!("amx".parse(), Ok(MatrixUnits::Amx));
}

/// Compares this rounding with a backend that computes in bfloat16, up to the order of sums. Burn's flex also
/// rounds results, and sums weight gradients in 16 bits.
#[test]
fn bf16_rounding_matches_the_definition() {
    let device = Device::flex().autodiff();
    let images = || [IMAGES, IMAGES, IMAGES].map(|shape| tensor(shape, 6, &device));
    let weight = || tensor([IMAGES[1], IMAGES[1], 1, 3, 3], 7, &device);
    let bias = || tensor([IMAGES[1]], 8, &device);
    let least = 4e-3;
    let ours = with_precision(ComputePrecision::Bf16, || run(images(), weight(), bias(), 1));
    let stock = with_stock_operations(|| {
        with_precision(ComputePrecision::Bf16, || run(images(), weight(), bias(), 1))
    });
    let exact = run(images(), weight(), bias(), 1);
    let worst = |a: &[f32], b: &[f32]| {
        let scale = b.iter().fold(0f32, |scale, value| scale.max(value.abs()));
        a.iter().zip(b).fold(0f32, |worst, (a, b)| worst.max((a - b).abs())) / scale
    };
    for part in 0..3 {
        let (apart, off) = (worst(&ours[part], &stock[part]), worst(&ours[part], &exact[part]));
        assert!(apart < 10.0 * least, "part {part}: {apart}");
        assert!(off > 0.02 * least && off < 4.0 * least, "part {part}: {off}");
    }
}

/// Checks that the precision holds for the closure only.
#[test]
fn single_precision_reads_back() {
    let device = Device::flex().autodiff();
    let x = tensor(IMAGES, 9, &device);
    let weight = tensor([2, IMAGES[1], 3, 3], 10, &device);
    let conv = || {
        let bias = Tensor::zeros([2], &device);
        list(conv_2d(std::slice::from_ref(&x), weight.clone(), bias, Options::default()).inner())
    };
    let exact = conv();
    let (reduced, within) = with_precision(ComputePrecision::Bf16, || {
        (conv(), with_precision(ComputePrecision::F32, conv))
    });
    assert_ne!(reduced, exact);
    assert_eq!(within, exact);
    assert_eq!(conv(), exact);
}
