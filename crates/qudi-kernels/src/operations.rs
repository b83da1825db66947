//! A count of the arithmetic of convolutions, for figures of speed.

use burn::backend::DispatchDevice;
use burn::tensor::Device;
use std::cell::Cell;

thread_local! {
    static OPERATIONS: Cell<u64> = const { Cell::new(0) };
}

/// Runs `run` and returns its result with the floating-point operations of its convolutions on this thread:
/// two for each product of a weight. Under autodiff a convolution counts three times, since each of its two
/// gradients takes as many again.
pub fn count_operations<T>(run: impl FnOnce() -> T) -> (T, u64) {
    let before = OPERATIONS.get();
    let result = run();
    (result, OPERATIONS.get() - before)
}

/// Adds operations that another thread has counted for this one.
pub fn add_operations(count: u64) {
    OPERATIONS.set(OPERATIONS.get() + count);
}

/// Counts a convolution with so many weights at so many places.
pub(crate) fn count(weights: usize, places: usize, device: &Device) {
    let passes = if matches!(device.as_dispatch(), DispatchDevice::Autodiff(_)) { 3 } else { 1 };
    OPERATIONS.set(OPERATIONS.get() + 2 * passes * (weights * places) as u64);
}
