//! LibTorch's operations give what flex gives, and the same gradients.
#![cfg(feature = "libtorch")]
#![allow(clippy::unwrap_used)]
#![allow(deprecated)] // LibTorch is deprecated upstream

use burn::tensor::{Device, Tensor, TensorData};
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::{residual_stack, warp, warp_cubic};

fn wave<const D: usize>(seed: f32, shape: [usize; D], device: &Device) -> Tensor<D> {
    let count: usize = shape.iter().product();
    let values: Vec<f32> = (0..count).map(|i| (seed + 0.7 * i as f32).sin()).collect();
    Tensor::from_data(TensorData::new(values, shape), device).require_grad()
}

/// Computes `run` of tensors of these shapes, and the gradients of a weighted sum of the result, on a device.
fn computed<const D: usize>(
    device: &Device,
    shapes: &[[usize; D]],
    run: &dyn Fn(&[Tensor<D>]) -> Tensor<4>,
) -> Vec<Vec<f32>> {
    let device = device.clone().autodiff();
    let inputs: Vec<_> =
        (0u8..).zip(shapes).map(|(k, &shape)| wave(f32::from(k), shape, &device)).collect();
    let output = run(&inputs);
    let weight = wave(9.0, output.dims(), &device).detach();
    let gradients = (output.clone() * weight).sum().backward();
    let values = |tensor: Tensor<D>| tensor.into_data().try_into_vec::<f32>().unwrap();
    let mut all = vec![output.inner().into_data().try_into_vec::<f32>().unwrap()];
    all.extend(inputs.iter().map(|input| values(input.grad(&gradients).unwrap())));
    all
}

fn assert_same<const D: usize>(shapes: &[[usize; D]], run: &dyn Fn(&[Tensor<D>]) -> Tensor<4>) {
    let [flex, torch] =
        [Device::flex(), Device::libtorch()].map(|device| computed(&device, shapes, run));
    for (number, (flex, torch)) in flex.iter().zip(&torch).enumerate() {
        let largest = flex.iter().fold(1.0f32, |most, v| most.max(v.abs()));
        let worst = flex.iter().zip(torch).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert_eq!(flex.len(), torch.len());
        assert!(worst < 3e-5 * largest, "result {number}: {worst} of {largest}");
    }
}

fn bias(outputs: usize, device: &Device) -> Tensor<1> {
    Tensor::full([outputs], 0.1, device)
}

#[test]
fn convolutions_of_frames() {
    for (kernel, stride) in [(1, 1), (3, 1), (3, 2), (7, 1)] {
        let shapes = [[3, 2, 9, 12], [3, 3, 9, 12], [4, 5, kernel, kernel]];
        assert_same(&shapes, &|x| {
            let options = Options { stride, activation: Activation::Relu, ..Options::default() };
            let bias = bias(4, &x[0].device());
            conv_2d(&[x[0].clone(), x[1].clone()], x[2].clone(), bias, options)
        });
    }
}

#[test]
fn convolutions_over_frames() {
    assert_same(&[[6, 2, 8, 7]], &|x| {
        let weight = wave(3.0, [4, 2, 3, 3, 3], &x[0].device()).detach();
        let addend = Some(Tensor::ones([6, 4, 8, 7], &x[0].device()));
        let options = Options { addend, ..Options::default() };
        conv_3d(&[x[0].clone()], weight, bias(4, &x[0].device()), 3, options)
    });
}

#[test]
fn stacks() {
    let shapes = [[2, 3, 6, 5], [2, 2, 6, 5], [8, 5, 3, 3], [8, 8, 3, 3], [8, 8, 3, 3]];
    for entry in [Activation::Relu, Activation::None] {
        assert_same(&shapes, &|x| {
            let device = x[0].device();
            let convolutions: Vec<_> =
                x[2..].iter().map(|weight| (weight.clone() * 0.2, bias(8, &device))).collect();
            residual_stack(&x[..2], &convolutions, entry)
        });
    }
}

#[test]
fn warps() {
    let shapes = [[2, 3, 6, 5], [2, 2, 6, 5]];
    assert_same(&shapes, &|x| warp(x[0].clone(), x[1].clone() * 1.7));
    assert_same(&shapes[..1], &|x| {
        let flow = wave(1.0, [2, 2, 6, 5], &x[0].device()).detach();
        warp_cubic(x[0].clone(), flow * 1.7)
    });
}

/// A recorded value stays as it was, whatever is computed in place of its source meanwhile.
#[test]
fn records_hold_their_inputs() {
    let device = Device::libtorch().autodiff();
    let x = wave(0.0, [1, 2, 4, 4], &device);
    let weight = wave(1.0, [3, 2, 3, 3], &device);
    let hidden = x.clone() * 2.0;
    let y =
        residual_stack(&[hidden.clone()], &[(weight.clone(), bias(3, &device))], Activation::Relu);
    let changed = (hidden + 5.0) * 3.0;
    let gradients = (y.sum() + changed.sum() * 0.0).backward();
    let gradient = weight.grad(&gradients).unwrap().into_data().try_into_vec::<f32>().unwrap();
    let expected = {
        let device = Device::flex().autodiff();
        let x = wave(0.0, [1, 2, 4, 4], &device);
        let weight = wave(1.0, [3, 2, 3, 3], &device);
        let y = residual_stack(&[x * 2.0], &[(weight.clone(), bias(3, &device))], Activation::Relu);
        let gradients = y.sum().backward();
        weight.grad(&gradients).unwrap().into_data().try_into_vec::<f32>().unwrap()
    };
    let worst = gradient.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-4, "{worst}");
}
