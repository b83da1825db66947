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

/// [Fills](fill) values that are written as they are.
pub(crate) fn written(length: usize, write: impl FnOnce(&mut [f32])) -> Vec<f32> {
    fill(length, |values| {
        // SAFETY: `write` writes every value before it reads any, as with `fill`.
        write(unsafe { std::slice::from_raw_parts_mut(values.as_mut_ptr().cast(), values.len()) });
    })
}
