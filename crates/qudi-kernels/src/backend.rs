//! Which tensors our own operations can take.

use burn::tensor::{Device, Tensor};
use std::cell::Cell;
use std::thread::LocalKey;

/// Whether tensors of this device are computed by the flex backend.
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

/// Whether tensors of this device are computed by a graphics card.
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

thread_local! {
    /// Whether this thread goes without our own operations.
    static STOCK: Cell<bool> = const { Cell::new(false) };
}

/// Sets a thread's variable until it is dropped, also by a panic.
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

/// Runs `run` with Burn's stock operations in place of our own on this thread: what ours are checked against.
pub fn with_stock_operations<T>(run: impl FnOnce() -> T) -> T {
    let _switch = Switch::turn(&STOCK, true);
    run()
}

/// Whether our own operations take this tensor: they are written for f32 on flex.
pub(crate) fn is_native<const D: usize>(tensor: &Tensor<D>) -> bool {
    tensor.dtype() == burn::tensor::DType::F32 && is_flex(&tensor.device()) && !STOCK.get()
}
