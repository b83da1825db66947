//! Tests of the warp: known translations, borders, and its gradients against finite differences.
#![allow(clippy::unwrap_used)]

use burn::tensor::{Device, Tensor, TensorData};
use qudi_kernels::{warp, warp_cubic};

const SIZE: [usize; 2] = [9, 13];

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // selected by name
    let ndarray = Device::ndarray();
    [Device::flex(), ndarray]
}

fn image(f: impl Fn(f32, f32) -> f32, device: &Device) -> Tensor<4> {
    let [height, width] = SIZE;
    let values: Vec<f32> =
        (0..height * width).map(|i| f((i % width) as f32, (i / width) as f32)).collect();
    Tensor::from_data(TensorData::new(values, [1, 1, height, width]), device)
}

fn constant_flow(x: f32, y: f32, device: &Device) -> Tensor<4> {
    let plane = |value| Tensor::<4>::full([1, 1, SIZE[0], SIZE[1]], value, device);
    Tensor::cat(vec![plane(x), plane(y)], 1)
}

fn values(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap()
}

#[test]
fn warp_by_a_translation_shifts_and_repeats_borders() {
    for device in devices() {
        // Bilinear interpolation reproduces a plane exactly.
        let x = image(|x, y| 3.0 * x - 2.0 * y, &device);
        for (dx, dy) in [(0.0, 0.0), (2.0, -3.0), (0.25, 1.5), (-40.0, 70.0)] {
            let got = values(warp(x.clone(), constant_flow(dx, dy, &device)));
            let [height, width] = SIZE;
            for (i, got) in got.iter().enumerate() {
                let column = ((i % width) as f32 + dx).clamp(0.0, (width - 1) as f32);
                let row = ((i / width) as f32 + dy).clamp(0.0, (height - 1) as f32);
                let expected = 3.0 * column - 2.0 * row;
                assert!(
                    (got - expected).abs() < 1e-4,
                    "({dx}, {dy}) at {i}: {got}, not {expected}"
                );
            }
        }
    }
}

/// The first frames of a burst lie in the memory of all: only theirs may be read and written.
#[test]
fn the_first_frames_of_a_burst_are_warped_alone() {
    for device in devices() {
        let frame = |k: f32| image(|x, y| (0.3 * x + k).sin() + 0.1 * y, &device);
        let burst = Tensor::cat(vec![frame(0.0), frame(1.0), frame(2.0)], 0);
        let flow = constant_flow(0.0, 0.0, &device).repeat_dim(0, 2);
        let first = burst.clone().narrow(0, 0, 2);
        let expected = values(Tensor::cat(vec![frame(0.0), frame(1.0)], 0));
        for warped in [warp(first.clone(), flow.clone()), warp_cubic(first, flow)] {
            let got = values(warped);
            assert_eq!(got.len(), expected.len());
            assert!(got.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5), "{got:?}");
        }
    }
}

#[test]
fn gradients_are_finite_differences() {
    let wave = |x: f32, y: f32| (0.7 * x + 0.3 * y).sin() + (0.2 * x * y).cos();
    // Fractional displacements: the slope jumps at integer coordinates.
    let (dx, dy) = (0.37, -0.42);
    for device in devices() {
        let weight = image(|x, y| (1.3 * x - 0.9 * y).sin(), &device);
        let sum = |x: Tensor<4>, flow: Tensor<4>| (warp(x, flow) * weight.clone()).sum();
        let device = device.clone().autodiff();
        let x = image(wave, &device).require_grad();
        let flow = constant_flow(dx, dy, &device).require_grad();
        let autodiff_weight = Tensor::from_inner(weight.clone());
        let grads = (warp(x.clone(), flow.clone()) * autodiff_weight).sum().backward();
        for (tensor, is_flow) in [(&x, false), (&flow, true)] {
            let gradient = values(tensor.grad(&grads).unwrap());
            let base = tensor.clone().inner();
            for place in (0..gradient.len()).step_by(7) {
                let step = 1e-2f32;
                let at = |offset: f32| {
                    let mut moved = values(base.clone());
                    moved[place] += offset;
                    let moved =
                        Tensor::from_data(TensorData::new(moved, base.dims()), &base.device());
                    let (x, flow) = (x.clone().inner(), flow.clone().inner());
                    let result = if is_flow { sum(x, moved) } else { sum(moved, flow) };
                    result.into_scalar::<f32>()
                };
                let expected = (at(step) - at(-step)) / (2.0 * step);
                let got = gradient[place];
                let off = (got - expected).abs();
                assert!(off < 5e-3, "flow: {is_flow}, {place}: {got}, not {expected}");
            }
        }
    }
}
