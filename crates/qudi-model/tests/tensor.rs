//! The bridge to tensors, on every CPU backend.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_model::tensor::{counts_to_tensor, tensor_to_frames};
use qudi_sim::Size;

#[allow(deprecated)] // ndarray is deprecated upstream and supported here on request
fn devices() -> [Device; 2] {
    [Device::flex(), Device::ndarray()]
}

#[test]
fn counts_become_tensors_and_come_back_as_frames() {
    let size = Size { height: 3, width: 5 };
    let counts: Vec<u16> = (0..30).map(|i| i % 8).collect();
    for device in devices() {
        let tensor = counts_to_tensor(&counts, 2, size, 7, &device).unwrap();
        assert_eq!(tensor.dims(), [2, 1, 3, 5]);
        let frames = tensor_to_frames(tensor * 7.0).unwrap();
        let back: Vec<u16> =
            frames.iter().flat_map(|f| &f.data).map(|v| v.round() as u16).collect();
        assert_eq!(back, counts);
    }
}

#[test]
fn wrong_sizes_are_errors() {
    let size = Size { height: 3, width: 5 };
    let error = counts_to_tensor(&[0; 29], 2, size, 7, &Device::flex()).unwrap_err();
    assert_eq!((error.got, error.expected), (29, 30));
}

/// One training-like step on both backends: gradients exist and agree.
#[test]
fn both_backends_differentiate_alike() {
    let size = Size { height: 4, width: 4 };
    let counts: Vec<u16> = (0..16).map(|i| i % 8).collect();
    let gradient = |device: Device| {
        let x = counts_to_tensor(&counts, 1, size, 7, &device.autodiff()).unwrap().require_grad();
        let loss = (x.clone().powi_scalar(2) * 3.0).mean();
        let gradients = loss.backward();
        x.grad(&gradients).unwrap().into_data().try_into_vec::<f32>().unwrap()
    };
    let [flex, ndarray] = devices().map(gradient);
    for ((a, b), &count) in flex.iter().zip(&ndarray).zip(&counts) {
        let expected = 6.0 * f32::from(count) / 7.0 / 16.0;
        assert!((a - expected).abs() < 1e-6 && (b - expected).abs() < 1e-6);
    }
}
