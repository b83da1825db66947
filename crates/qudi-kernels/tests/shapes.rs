//! Convolutions compared with Burn's own on the ndarray backend over many shapes: several tiles, more planes
//! than fit into scratch memory, odd sizes, channels that fill no block.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/golden/cases.rs"]
mod cases;

use burn::tensor::{Device, Tensor, TensorData};
use cases::uniform;
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};

/// Images, frames, channels of the inputs, height, width, outputs, kernel, stride.
type Shape = (usize, usize, &'static [usize], usize, usize, usize, [usize; 3], usize);

const SHAPES: &[Shape] = &[
    (1, 1, &[1], 1, 1, 1, [1, 1, 1], 1),
    (2, 1, &[3], 5, 7, 2, [1, 3, 3], 1),
    (1, 1, &[2, 3, 1], 5, 200, 5, [1, 3, 3], 1),
    (1, 1, &[2], 25, 401, 6, [1, 3, 3], 2),
    (3, 1, &[7], 9, 6, 13, [1, 1, 1], 2),
    (1, 1, &[5], 20, 13, 7, [1, 7, 7], 1),
    (1, 1, &[250], 12, 30, 3, [1, 3, 3], 1),
    (1, 1, &[5, 4], 50, 61, 12, [1, 1, 1], 1),
    (6, 3, &[2, 2], 10, 9, 4, [5, 5, 5], 1),
    (8, 4, &[3], 11, 12, 6, [5, 5, 5], 2),
    (4, 2, &[9], 16, 16, 8, [3, 3, 3], 1),
    (1, 1, &[2], 2, 2, 3, [1, 7, 7], 2),
    (3, 1, &[20, 12], 37, 53, 25, [1, 3, 3], 1),
    (4, 2, &[9], 14, 14, 18, [3, 3, 3], 1),
    (1, 1, &[40], 71, 131, 17, [1, 3, 3], 1),
    (2, 1, &[16], 3, 1, 16, [1, 3, 3], 1),
    (1, 1, &[300], 9, 15, 20, [1, 3, 3], 1),
];

fn values(count: usize, seed: usize) -> Vec<f32> {
    uniform(&format!("shapes {seed}"), count).into_iter().map(|value| value as f32).collect()
}

/// Returns the output and the gradients of all inputs, weight and bias.
fn run(shape: Shape, relu: bool, device: &Device) -> Vec<Vec<f32>> {
    let (images, frames, channels, height, width, outputs, kernel, stride) = shape;
    let tensor =
        |size: &[usize], seed| TensorData::new(values(size.iter().product(), seed), size.to_vec());
    let inputs: Vec<Tensor<4>> = (1..)
        .zip(channels)
        .map(|(seed, &c)| {
            Tensor::from_data(tensor(&[images, c, height, width], seed), device).require_grad()
        })
        .collect();
    let all = channels.iter().sum();
    let [depth, rows, columns] = kernel;
    let weight: Tensor<5> =
        Tensor::from_data(tensor(&[outputs, all, depth, rows, columns], 77), device).require_grad();
    let bias: Tensor<1> = Tensor::from_data(tensor(&[outputs], 78), device).require_grad();
    let activation = if relu { Activation::Relu } else { Activation::None };
    let options = Options { stride, activation, ..Options::default() };
    let output = if depth == 1 {
        let weight = weight.clone().reshape([outputs, all, rows, columns]);
        conv_2d(&inputs, weight, bias.clone(), options)
    } else {
        conv_3d(&inputs, weight.clone(), bias.clone(), frames, options)
    };
    let cotangent = Tensor::from_data(tensor(&output.dims(), 79), device);
    let grads = (output.clone() * cotangent).sum().backward();
    let mut results = vec![output.inner().into_data()];
    results.extend(inputs.iter().map(|input| input.grad(&grads).unwrap().into_data()));
    results.push(weight.grad(&grads).unwrap().into_data());
    results.push(bias.grad(&grads).unwrap().into_data());
    results.into_iter().map(|data| data.try_to_vec().unwrap()).collect()
}

#[test]
fn output_shapes_match_burn() {
    #[allow(deprecated)] // selected by name
    let burns = Device::ndarray().autodiff();
    let ours = Device::flex().autodiff();
    for &shape in SHAPES {
        for relu in [false, true] {
            let expected = run(shape, relu, &burns);
            let got = run(shape, relu, &ours);
            for (part, (got, expected)) in got.iter().zip(&expected).enumerate() {
                assert_eq!(got.len(), expected.len(), "{shape:?}, part {part}");
                let scale = expected.iter().fold(1e-3f32, |scale, value| scale.max(value.abs()));
                for (got, expected) in got.iter().zip(expected) {
                    let off = (got - expected).abs() / scale;
                    assert!(off < 2e-5, "{shape:?}, part {part}: {got} instead of {expected}");
                }
            }
        }
    }
}

#[test]
fn threads_do_not_change_the_result() {
    let device = Device::flex().autodiff();
    for shape in [SHAPES[3], SHAPES[9], SHAPES[12]] {
        let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let one = pool(1).install(|| run(shape, true, &device));
        let three = pool(3).install(|| run(shape, true, &device));
        assert_eq!(one, three, "{shape:?}");
    }
}
