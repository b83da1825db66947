//! Results that are written once, without zeroing the memory before.
#![allow(unsafe_code)]

use std::mem::MaybeUninit;

/// A vector of `length` values, all of which `write` must have written.
///
/// Zeroing them first would cost as much as a light operation itself.
pub(crate) fn fill(length: usize, write: impl FnOnce(&mut [MaybeUninit<f32>])) -> Vec<f32> {
    let mut values = Vec::with_capacity(length);
    write(&mut values.spare_capacity_mut()[..length]);
    // SAFETY: every caller in this crate writes whole planes that together cover the result.
    unsafe { values.set_len(length) };
    values
}
