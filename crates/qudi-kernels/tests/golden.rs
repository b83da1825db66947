//! Every operation compared with PyTorch, forward and backward, on both CPU backends. Flex uses the
//! operations of this crate, ndarray uses Burn's.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/golden/cases.rs"]
mod cases;

use burn::tensor::{Device, Tensor};
use cases::{Case, File};
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::group_norm::{self, Norm, group_norm};
use qudi_kernels::{tv_flow, warp, warp_cubic};

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // selected by name
    let ndarray = Device::ndarray();
    [Device::flex().autodiff(), ndarray.autodiff()]
}

/// Compares the gradients of the case's sum for inputs and parameters.
fn check<const D: usize, const E: usize>(
    case: &Case<'_>,
    output: Tensor<4>,
    inputs: &[(&str, &Tensor<4>)],
    others: &[(&str, &Tensor<D>)],
    biases: &[(&str, &Tensor<E>)],
) {
    let device = output.device();
    case.check_output("y", output.clone().inner());
    let grads = (output * case.cotangent("y", &device)).sum().backward();
    for (name, tensor) in inputs {
        case.check_gradient(name, tensor.grad(&grads).unwrap());
    }
    for (name, tensor) in others {
        case.check_gradient(name, tensor.grad(&grads).unwrap());
    }
    for (name, tensor) in biases {
        case.check_gradient(name, tensor.grad(&grads).unwrap());
    }
}

#[test]
fn convolutions_match_pytorch() {
    let file = File::open("kernels/conv");
    for device in devices() {
        for case in file.cases() {
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let bias: Tensor<1> = if case.has_parameter("conv.bias") {
                case.parameter("conv.bias", &device).require_grad()
            } else {
                Tensor::zeros([3], &device)
            };
            let stride = &case.about[if case.about["conv"] == "3d" { "strides" } else { "stride" }];
            let stride = stride.as_array().map_or(stride, |strides| &strides[2]);
            let relu = case.is("relu");
            let options = Options {
                stride: stride.as_u64().unwrap() as usize,
                activation: if relu { Activation::Relu } else { Activation::None },
                ..Options::default()
            };
            let biases =
                if case.has_parameter("conv.bias") { vec![("conv.bias", &bias)] } else { vec![] };
            if case.about["conv"] == "3d" {
                let weight: Tensor<5> = case.parameter("conv.weight", &device).require_grad();
                let frames = case.number("frames");
                // Inputs in parts must give the same result as one.
                let parts = [x.clone().narrow(1, 0, 1), x.clone().narrow(1, 1, 1)];
                let y = conv_3d(&parts, weight.clone(), bias.clone(), frames, options);
                check(&case, y, &[("x", &x)], &[("conv.weight", &weight)], &biases);
            } else {
                let weight: Tensor<4> = case.parameter("conv.weight", &device).require_grad();
                let y = conv_2d(std::slice::from_ref(&x), weight.clone(), bias.clone(), options);
                check(&case, y, &[("x", &x)], &[("conv.weight", &weight)], &biases);
            }
        }
    }
}

#[test]
fn addend_is_added_and_receives_its_gradient() {
    for device in devices() {
        let random = |name: &str, shape: [usize; 4]| -> Tensor<4> {
            let values = cases::uniform(name, shape.iter().product());
            let values = values.iter().map(|&v| v as f32).collect::<Vec<_>>();
            Tensor::from_data(burn::tensor::TensorData::new(values, shape), &device).require_grad()
        };
        let x = random("x", [2, 5, 9, 7]);
        let weight = random("w", [6, 5, 3, 3]);
        let addend = random("a", [2, 6, 9, 7]);
        let bias = Tensor::<1>::zeros([6], &device);
        let call = |addend: Option<Tensor<4>>, activation| {
            let options = Options { addend, activation, ..Options::default() };
            conv_2d(std::slice::from_ref(&x), weight.clone(), bias.clone(), options)
        };
        let fused = call(Some(addend.clone()), Activation::Relu);
        let apart = burn::tensor::activation::relu(call(None, Activation::None) + addend.clone());
        let off = (fused.clone() - apart.clone()).abs().max().into_scalar::<f32>();
        assert!(off < 1e-5, "{device:?}: off by {off}");
        let (fused, apart) = (fused.powi_scalar(2).sum(), apart.powi_scalar(2).sum());
        let (fused, apart) = (fused.backward(), apart.backward());
        for tensor in [&x, &weight, &addend] {
            let difference = tensor.grad(&fused).unwrap() - tensor.grad(&apart).unwrap();
            let off = difference.abs().max().into_scalar::<f32>();
            assert!(off < 1e-3, "{device:?}: gradient off by {off}");
        }
    }
}

#[test]
fn group_norm_matches_pytorch() {
    let file = File::open("kernels/group_norm");
    for device in devices() {
        for case in file.cases() {
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let weight: Tensor<1> = case.parameter("norm.weight", &device).require_grad();
            let bias: Tensor<1> = case.parameter("norm.bias", &device).require_grad();
            let activation = if case.is("silu") {
                group_norm::Activation::Silu
            } else {
                group_norm::Activation::None
            };
            let norm = Norm { groups: case.number("groups"), activation };
            let (w, b) = (weight.clone().unsqueeze(), bias.clone().unsqueeze());
            let parameters = [("norm.weight", &weight), ("norm.bias", &bias)];
            if case.is("film") {
                let scale: Tensor<2> = case.input("scale", &device).require_grad();
                let shift: Tensor<2> = case.input("shift", &device).require_grad();
                let slope = scale.clone() + 1.0;
                let y = group_norm(x.clone(), slope.clone() * w, slope * b + shift.clone(), norm);
                let film = [("scale", &scale), ("shift", &shift)];
                check(&case, y, &[("x", &x)], &parameters, &film);
            } else {
                let y = group_norm(x.clone(), w, b, norm);
                check::<1, 1>(&case, y, &[("x", &x)], &parameters, &[]);
            }
        }
    }
}

#[test]
fn warps_match_pytorch() {
    let file = File::open("kernels/warp");
    for device in devices() {
        for case in file.cases() {
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let flow: Tensor<4> = case.input("flow", &device).require_grad();
            let y = warp(x.clone(), flow.clone());
            let mut inputs = vec![("x", &x)];
            if case.expected("grad.flow").is_some() {
                inputs.push(("flow", &flow));
            }
            check::<1, 1>(&case, y, &inputs, &[], &[]);
        }
    }
}

#[test]
fn cubic_warps_match_pytorch() {
    let file = File::open("kernels/warp_cubic");
    for device in devices() {
        for case in file.cases() {
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let y = warp_cubic(x.clone(), case.input("flow", &device));
            check::<1, 1>(&case, y, &[("x", &x)], &[], &[]);
        }
    }
}

#[test]
fn tv_flows_match_pytorch() {
    let file = File::open("kernels/tv_flow");
    for device in devices() {
        for case in file.cases() {
            let [reference, neighbour, start] =
                ["reference", "neighbour", "start"].map(|name| case.input(name, &device));
            case.check_output("y", tv_flow(reference, neighbour, start).inner());
        }
    }
}
