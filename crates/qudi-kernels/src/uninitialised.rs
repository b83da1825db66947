//! Vectors that are written once, without zeroing their memory before.
#![allow(unsafe_code)]

use std::mem::MaybeUninit;

/// Creates a vector of `length` values, all of which `write` must write.
///
/// Zeroing them first would cost as much as a light operation itself.
pub(crate) fn fill(length: usize, write: impl FnOnce(&mut [MaybeUninit<f32>])) -> Vec<f32> {
    let mut values = Vec::with_capacity(length);
    write(&mut values.spare_capacity_mut()[..length]);
    // SAFETY: every caller in this crate writes whole planes that together cover the result.
    unsafe { values.set_len(length) };
    values
}
