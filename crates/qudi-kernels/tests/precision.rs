//! Reduced precision against single precision on numbers that were rounded by hand.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/golden/cases.rs"]
mod cases;

use burn::tensor::{Device, Tensor, TensorData, bf16};
use cases::uniform;
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::{ComputePrecision, with_precision, with_stock_operations};

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

/// Sum, and gradients of input, weight, bias and addend for `cotangent`.
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

/// Products are of rounded numbers, summed in 32 bits and rounded once; bias and addend keep all their bits.
/// On the way back the same holds of gradients.
#[test]
fn bf16_rounds_products_only() {
    let device = Device::flex().autodiff();
    for (kernel, stride) in [([1, 3, 3], 1), ([1, 3, 3], 2), ([1, 1, 1], 1), ([3, 5, 5], 1)] {
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
        let nothing = addend.zeros_like();
        let images = [rounded(x), nothing, rounded(cotangent.clone())];
        let zeros = bias.zeros_like();
        let [sum, of_x, of_weight, ..] = run(images, rounded(weight), zeros, stride);
        let [bias, addend, cotangent] = [list(bias), list(addend), list(cotangent)];
        let plane = grid[2] * grid[3];
        let expected = sum
            .into_iter()
            .enumerate()
            .map(|(place, sum)| round(sum) + bias[place / plane % OUTPUTS] + addend[place]);
        let about = format!("{kernel:?}, {stride}");
        assert_eq!(got[0], expected.collect::<Vec<_>>(), "{about}");
        assert_eq!(got[1], of_x.into_iter().map(round).collect::<Vec<_>>(), "{about}");
        assert_eq!(got[2], of_weight.into_iter().map(round).collect::<Vec<_>>(), "{about}");
        let mut of_bias = vec![0.0; OUTPUTS];
        for (place, value) in cotangent.iter().enumerate() {
            of_bias[place / plane % OUTPUTS] += value;
        }
        for (got, expected) in got[3].iter().zip(of_bias) {
            assert!((got - expected).abs() < 1e-4, "{got} and {expected}: {about}");
        }
        assert_eq!(got[4], cotangent, "{about}");
    }
}

/// What is rounded here is what a backend with such numbers computes, but for the order of sums; flex sums
/// weights' gradients in 16 bits.
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
        assert!(off > 0.1 * least && off < 4.0 * least, "part {part}: {off}");
    }
}

/// The switch holds for what runs inside of it, and ends with it.
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
