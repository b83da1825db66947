//! Selection of tensors that the operations of this crate support.

use burn::tensor::{Device, Tensor};
use std::cell::Cell;
use std::thread::LocalKey;

/// Returns true if the flex backend computes tensors of this device.
pub fn is_flex(device: &Device) -> bool {
    #[cfg(feature = "flex")]
    {
        use burn::backend::DispatchDevice;
        match device.as_dispatch() {
            DispatchDevice::Autodiff(device) => matches!(**device, DispatchDevice::Flex(_)),
            device => matches!(device, DispatchDevice::Flex(_)),
        }
    }
    #[cfg(not(feature = "flex"))]
    {
        let _ = device;
        false
    }
}

/// Returns true if a graphics card computes this tensor with the operations of this crate.
pub(crate) fn is_cube<const D: usize>(tensor: &Tensor<D>) -> bool {
    #[cfg(feature = "cube")]
    {
        use burn::backend::DispatchDevice;
        let is_cube = match tensor.device().as_dispatch() {
            DispatchDevice::Autodiff(device) => matches!(**device, DispatchDevice::Cube(_)),
            device => matches!(device, DispatchDevice::Cube(_)),
        };
        is_cube && tensor.dtype() == burn::tensor::DType::F32 && !STOCK.get()
    }
    #[cfg(not(feature = "cube"))]
    {
        let _ = tensor;
        false
    }
}

/// Returns true if LibTorch computes tensors of this device, on a processor or on a card.
fn is_libtorch(device: &Device) -> bool {
    #[cfg(feature = "libtorch")]
    {
        use burn::backend::DispatchDevice;
        match device.as_dispatch() {
            DispatchDevice::Autodiff(device) => matches!(**device, DispatchDevice::LibTorch(_)),
            device => matches!(device, DispatchDevice::LibTorch(_)),
        }
    }
    #[cfg(not(feature = "libtorch"))]
    {
        let _ = device;
        false
    }
}

/// Returns true if LibTorch computes this tensor with the operations of this crate.
pub(crate) fn is_recorded<const D: usize>(tensor: &Tensor<D>) -> bool {
    tensor.dtype() == burn::tensor::DType::F32 && is_libtorch(&tensor.device()) && !STOCK.get()
}

thread_local! {
    /// True if this thread uses Burn's stock operations only.
    static STOCK: Cell<bool> = const { Cell::new(false) };
}

/// Guard that sets a thread-local variable until it is dropped, also during a panic.
pub(crate) struct Switch<T: Copy + 'static> {
    variable: &'static LocalKey<Cell<T>>,
    before: T,
}

impl<T: Copy> Switch<T> {
    pub(crate) fn turn(variable: &'static LocalKey<Cell<T>>, value: T) -> Self {
        Self { variable, before: variable.replace(value) }
    }
}

impl<T: Copy> Drop for Switch<T> {
    fn drop(&mut self) {
        self.variable.set(self.before);
    }
}

/// Runs `run` on this thread with Burn's stock operations in place of the operations of this crate. Tests
/// compare the two.
pub fn with_stock_operations<T>(run: impl FnOnce() -> T) -> T {
    let _switch = Switch::turn(&STOCK, true);
    run()
}

/// Returns true if the operations of this crate support this tensor: f32 on flex.
pub(crate) fn is_native<const D: usize>(tensor: &Tensor<D>) -> bool {
    tensor.dtype() == burn::tensor::DType::F32 && is_flex(&tensor.device()) && !STOCK.get()
}
