//! Which tensors our own operations can take.

use burn::tensor::{Device, Tensor};
use std::cell::Cell;

/// Whether tensors of this device are computed by the flex backend.
pub fn is_flex(device: &Device) -> bool {
    #[cfg(feature = "flex")]
    {
        use burn::backend::DispatchDevice;
        match device.as_dispatch() {
            DispatchDevice::Flex(_) => true,
            DispatchDevice::Autodiff(device) => matches!(**device, DispatchDevice::Flex(_)),
            #[allow(unreachable_patterns)] // with other backends compiled in there are more
            _ => false,
        }
    }
    #[cfg(not(feature = "flex"))]
    {
        let _ = device;
        false
    }
}

thread_local! {
    /// Whether this thread goes without our own operations.
    static STOCK: Cell<bool> = const { Cell::new(false) };
}

/// Runs `run` with Burn's stock operations in place of our own on this thread: what ours are checked against.
pub fn with_stock_operations<T>(run: impl FnOnce() -> T) -> T {
    /// Puts the switch back, also when `run` panics.
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            STOCK.set(self.0);
        }
    }
    let _restore = Restore(STOCK.replace(true));
    run()
}

/// Whether our own operations take this tensor: they are written for f32 on flex.
pub(crate) fn is_native<const D: usize>(tensor: &Tensor<D>) -> bool {
    tensor.dtype() == burn::tensor::DType::F32 && is_flex(&tensor.device()) && !STOCK.get()
}
