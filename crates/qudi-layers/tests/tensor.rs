//! Conversion to tensors and back, on every CPU backend.
#![allow(clippy::unwrap_used)]

use burn::tensor::Device;
use qudi_core::Size;
use qudi_layers::tensor::{read, to_tensor};

#[test]
fn tensors_hold_images_unchanged() {
    #[allow(deprecated)] // selected by name
    let devices = [Device::flex(), Device::ndarray()];
    let values: Vec<f32> = (0..30).map(|i| i as f32).collect();
    for device in devices {
        let tensor = to_tensor(values.clone(), Size { height: 3, width: 5 }, &device);
        assert_eq!(tensor.dims(), [2, 1, 3, 5]);
        assert_eq!(read(tensor).unwrap(), values);
    }
}
