//! Products of pairs of bfloat16 on the vector unit (AVX512-BF16).
#![allow(unsafe_code)]

use super::micro::Products;
use crate::matrix_units::MatrixUnits;
use pulp::x86::V4;
use std::arch::x86_64::{__m512, __m512bh, _mm512_dpbf16_ps};
use std::mem::transmute;

/// Multiplication of entries that hold two bfloat16 each, whose products are added.
#[derive(Debug)]
pub(super) struct Pairs;

impl Products<V4> for Pairs {
    #[inline(always)]
    unsafe fn multiply_add(
        _: V4,
        a: pulp::f32x16,
        b: pulp::f32x16,
        sum: pulp::f32x16,
    ) -> pulp::f32x16 {
        // SAFETY: all are 64 bytes without invalid values; the caller promises the instruction.
        unsafe {
            let a = transmute::<pulp::f32x16, __m512bh>(a);
            let b = transmute::<pulp::f32x16, __m512bh>(b);
            let sum = transmute::<pulp::f32x16, __m512>(sum);
            transmute::<__m512, pulp::f32x16>(_mm512_dpbf16_ps(sum, a, b))
        }
    }
}

/// Work compiled for the AVX512-BF16 unit.
pub(super) trait PairWork {
    /// Does the work; inlined.
    ///
    /// # Safety
    /// The processor must have AVX512-BF16.
    unsafe fn work(self, simd: V4);
}

/// Runs `work`, compiled for AVX512-BF16.
///
/// # Safety
/// The processor must have AVX512-BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16,avx2,fma,bmi2")]
unsafe fn compiled(simd: V4, work: impl PairWork) {
    // SAFETY: the caller's promise.
    unsafe { work.work(simd) }
}

/// Runs `work`. Scratch memory must hold pairs, which it does only on processors that multiply them.
pub(super) fn with_pairs(work: impl PairWork) {
    debug_assert!(MatrixUnits::Avx512Bf16.is_available());
    let Some(simd) = V4::try_new() else { unreachable!("the units were found before") };
    // SAFETY: scratch memory holds pairs only where AVX512-BF16 was found.
    unsafe { compiled(simd, work) }
}
